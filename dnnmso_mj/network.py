"""The deep network f̂: its shape and initial weights, and the torch reference of its gradient.

    f̂(X) = W_L σ(W_{L−1} … σ(W₁ [X; 1]))        (linear output layer)

The constant 1 stands beside the inputs of every layer (`bias`); the paper keeps it implicit. All
weights live in one flat vector, layer after layer, each a row-major (n_out, n_in + bias) matrix.
The compiled counterpart is `dnnmso_mj.kernel`, which tests hold to this one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from dnnmso_mj.scenario import Network as NetworkSpec

if TYPE_CHECKING:
    import torch

Array = np.ndarray
Activation = Literal["sigmoid", "tanh", "relu"]

# Kumar 2017, eq. 17: std·√fan_in = 1/(σ'(0)·√(1 + σ(0)²)), rounded for the sigmoid as in the paper;
# He et al. 2015 for the ReLU, which has no slope at 0.
INIT_SCALE: dict[Activation, float] = {"sigmoid": 3.6, "tanh": 1.0, "relu": float(np.sqrt(2.0))}


@dataclass(frozen=True)
class Shape:
    """Layer sizes of a network.

    Args:
        sizes: widths from the input to the output, n_in, hidden …, n_out.
        bias: whether each layer sees a constant 1 beside its inputs.
        activation: of the hidden layers.
    """

    sizes: tuple[int, ...]
    bias: bool
    activation: Activation

    @property
    def n_layers(self) -> int:
        """L, the number of weight layers."""
        return len(self.sizes) - 1

    @property
    def matrices(self) -> list[tuple[int, int]]:
        """(rows, columns) of each weight matrix."""
        pairs = zip(self.sizes, self.sizes[1:], strict=False)
        return [(n_out, n_in + self.bias) for n_in, n_out in pairs]

    @property
    def n_weights(self) -> int:
        """Number of all weights."""
        return sum(rows * columns for rows, columns in self.matrices)

    def split(self, flat: Array) -> list[Array]:
        """Views of a flat vector (n_weights,) as the layers' matrices."""
        views, start = [], 0
        for rows, columns in self.matrices:
            views.append(flat[start : start + rows * columns].reshape(rows, columns))
            start += rows * columns
        return views


def network_shape(spec: NetworkSpec, n_in: int, n_out: int) -> Shape:
    """Shape of the network that a scenario asks for."""
    return Shape((n_in, *spec.hidden, n_out), spec.bias, spec.activation)


def initial_weights(shape: Shape, spec: NetworkSpec, rng: np.random.Generator) -> Array:
    """Draw W_l ~ N(0, c/√fan_in), c = 3.6 for the sigmoid (Kumar 2017; simulation section).

    N.B. the paper prints c/√L and does not say whether it is a standard deviation or a variance:
    `init_spread` chooses. fan_in counts the constant input.

    Returns:
        Flat weights (n_weights,), none of which is zero: Madam could never move it.
    """
    scale = INIT_SCALE[shape.activation] if spec.init_scale is None else spec.init_scale
    layers = []
    for rows, columns in shape.matrices:
        spread = scale / np.sqrt(columns)
        std = spread if spec.init_spread == "standard_deviation" else np.sqrt(spread)
        layers.append(rng.normal(0.0, std, size=rows * columns))
    layers[-1] *= spec.output_scale
    weights: Array = np.concatenate(layers)
    return weights


class TorchNetwork:
    """The reference: the same network in torch, differentiated by autograd.

    Args:
        shape: layer sizes.
        weights: flat initial weights (n_weights,), whose precision becomes its own; copied.
    """

    def __init__(self, shape: Shape, weights: Array) -> None:
        import torch

        self._torch = torch
        self.shape = shape
        self.parameters = [torch.tensor(W, requires_grad=True) for W in shape.split(weights)]
        self._activation = {"sigmoid": torch.sigmoid, "tanh": torch.tanh, "relu": torch.relu}[
            shape.activation
        ]

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        """f̂(x): (n_in,) -> (n_out,), recorded for autograd."""
        a = x
        for k, W in enumerate(self.parameters):
            if self.shape.bias:
                a = self._torch.cat([a, a.new_ones(1)])
            a = W @ a
            if k < self.shape.n_layers - 1:
                a = self._activation(a)
        return a

    def flat(self) -> Array:
        """All weights, flat (n_weights,)."""
        return np.concatenate([W.detach().numpy().ravel() for W in self.parameters])

    def flat_gradient(self) -> Array:
        """All gradients of the last backward pass, flat (n_weights,)."""
        gradients = [W.grad for W in self.parameters]
        return np.concatenate([g.numpy().ravel() for g in gradients if g is not None])
