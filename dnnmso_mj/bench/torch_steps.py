"""The control step in torch, as an able user writes it, and as one who wants speed writes it.

Both learn one sample a call by Madam, as `dnnmso_mj.kernel` does; neither checks or watches
anything. Importing this module imports torch.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch import nn

from dnnmso_mj.network import Shape
from dnnmso_mj.scenario import Madam as MadamSpec

Array = np.ndarray


class TorchMadam(torch.optim.Optimizer):
    """Alg. 1, parameter by parameter, in place wherever torch can."""

    def __init__(self, parameters: Iterable[torch.Tensor], spec: MadamSpec) -> None:
        super().__init__(parameters, {})
        self._eta, self._beta, self._sigma = spec.eta, spec.beta, spec.sigma_max
        self._most = spec.eta_max / spec.eta

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Update every parameter from its `.grad`."""
        for group in self.param_groups:
            for W in group["params"]:
                g, state = W.grad, self.state[W]
                if not state:
                    state["g_bar_sq"] = torch.zeros_like(W)
                    state["tiny"] = torch.finfo(W.dtype).tiny
                g_bar_sq = state["g_bar_sq"]
                g_bar_sq.mul_(self._beta).addcmul_(g, g, value=1 - self._beta)
                ratio = g / g_bar_sq.sqrt().clamp_min_(state["tiny"])
                ratio.clamp_(-self._most, self._most).mul_(W.sign()).mul_(-self._eta)
                W.mul_(ratio.exp_()).clamp_(-self._sigma, self._sigma)


class PlainTorch:
    """nn.Sequential, autograd and an optimiser.

    Args:
        shape: layer sizes, of a sigmoid network with biases.
        weights: flat initial weights (n_weights,); their precision becomes the network's.
        spec: Madam's parameters.
    """

    def __init__(self, shape: Shape, weights: Array, spec: MadamSpec) -> None:
        torch.set_num_threads(1)
        layers: list[nn.Module] = []
        for W in map(torch.from_numpy, shape.split(weights.copy())):
            rows, columns = W.shape
            linear = nn.Linear(columns - 1, rows, dtype=W.dtype)
            with torch.no_grad():
                linear.weight.copy_(W[:, :-1])
                linear.bias.copy_(W[:, -1])
            layers += [linear, nn.Sigmoid()]
        self._network = nn.Sequential(*layers[:-1])
        self._optimizer = TorchMadam(self._network.parameters(), spec)
        self._output = torch.empty(0)

    def predict(self, x: Array) -> Array:
        """Output (n_out,) for x (n_in,)."""
        self._output = self._network(torch.from_numpy(x))
        prediction: Array = self._output.detach().numpy()
        return prediction

    def learn(self, delta: Array) -> None:
        """One update from ∂loss/∂output (n_out,)."""
        self._optimizer.zero_grad()
        self._output.backward(torch.from_numpy(delta))  # type: ignore[no-untyped-call]
        self._optimizer.step()

    def weights(self) -> Array:
        """All weights, flat, as given."""
        linears = [layer for layer in self._network if isinstance(layer, nn.Linear)]
        matrices = [torch.cat([layer.weight, layer.bias[:, None]], 1) for layer in linears]
        return np.concatenate([W.detach().numpy().ravel() for W in matrices])


class FlatTorch:
    """Backward pass by hand, weights and moments one vector each, nothing allocated.

    Args: as for `PlainTorch`.
    """

    def __init__(self, shape: Shape, weights: Array, spec: MadamSpec) -> None:
        torch.set_num_threads(1)
        self._spec, self._most = spec, spec.eta_max / spec.eta
        w = self._w = torch.from_numpy(weights.copy())
        self._v, self._g, self._ratio, self._sign = (torch.zeros_like(w) for _ in range(4))
        self._tiny = torch.finfo(w.dtype).tiny

        def layers(flat: torch.Tensor) -> list[torch.Tensor]:
            return [torch.from_numpy(view) for view in shape.split(flat.numpy())]

        self._W, self._G = layers(w), layers(self._g)
        self._WT = [W[:, :-1].T for W in self._W]
        # The constant input stands behind each layer's activations.
        self._inputs = [torch.ones(size + 1, dtype=w.dtype) for size in shape.sizes[:-1]]
        self._acts = [inputs[:-1] for inputs in self._inputs]
        self._acts.append(torch.zeros(shape.sizes[-1], dtype=w.dtype))
        self._deltas = [torch.zeros(size, dtype=w.dtype) for size in shape.sizes]
        self._slopes = [torch.zeros(size, dtype=w.dtype) for size in shape.sizes]

    @torch.inference_mode()
    def predict(self, x: Array) -> Array:
        """Output (n_out,) for x (n_in,); overwritten by the next call."""
        self._acts[0].copy_(torch.from_numpy(x))
        for W, inputs, out in zip(self._W, self._inputs, self._acts[1:], strict=True):
            torch.mv(W, inputs, out=out)
            if W is not self._W[-1]:
                out.sigmoid_()
        prediction: Array = self._acts[-1].numpy()
        return prediction

    @torch.inference_mode()
    def learn(self, delta: Array) -> None:
        """One update from ∂loss/∂output (n_out,)."""
        self._deltas[-1].copy_(torch.from_numpy(delta))
        for k in range(len(self._W) - 1, -1, -1):
            torch.outer(self._deltas[k + 1], self._inputs[k], out=self._G[k])
            if k > 0:
                a, slope, below = self._acts[k], self._slopes[k], self._deltas[k]
                torch.mv(self._WT[k], self._deltas[k + 1], out=below)
                torch.mul(a, a, out=slope)
                torch.sub(a, slope, out=slope)
                below.mul_(slope)
        self._update()

    def _update(self) -> None:
        spec, w, v, g, ratio = self._spec, self._w, self._v, self._g, self._ratio
        v.mul_(spec.beta).addcmul_(g, g, value=1 - spec.beta)
        torch.sqrt(v, out=ratio)
        torch.div(g, ratio.clamp_min_(self._tiny), out=ratio)
        torch.sign(w, out=self._sign)
        ratio.clamp_(-self._most, self._most).mul_(self._sign).mul_(-spec.eta).exp_()
        w.mul_(ratio).clamp_(-spec.sigma_max, spec.sigma_max)

    def weights(self) -> Array:
        """All weights, flat, as given."""
        return self._w.numpy().copy()
