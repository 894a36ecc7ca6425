"""A network that learns one sample a tick by Madam, with the monitors of `theory`.

Two backends with one interface: the compiled kernel, and torch's autograd as the reference. A tick
is `predict`, then `learn` with the gradient of the loss by the network's output.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba.core import event

from dnnmso_mj import kernel
from dnnmso_mj.errors import MissingExtraError, NonFiniteError
from dnnmso_mj.network import Shape, TorchNetwork, initial_weights, network_shape
from dnnmso_mj.scenario import Madam as MadamSpec
from dnnmso_mj.scenario import Network as NetworkSpec
from dnnmso_mj.theory import layer_monitors

Array = np.ndarray

# The measured turn of the gradient costs a second backward pass: one tick in ten pays for it.
GRADIENT_CHANGE_EVERY = 10


@dataclass
class Monitors:
    """What one update did; (L,) arrays, overwritten by the next update."""

    weight_norm: Array
    update_ratio: Array
    eta_bound: Array
    gradient_change: Array
    drt_bound: float = 0.0
    clipped: bool = False

    @classmethod
    def zeros(cls, n_layers: int) -> Monitors:
        """Monitors before the first update."""
        norm, ratio, bound, change = np.zeros((4, n_layers))
        return cls(norm, ratio, bound, change)


class Learner(Protocol):
    """A network trained online."""

    shape: Shape
    monitors: Monitors

    def predict(self, x: Array) -> Array:
        """Output (n_out,) for input x (n_in,); overwritten by the next call."""

    def learn(self, delta: Array) -> None:
        """One Madam update from ∂loss/∂output (n_out,) at the last predicted input."""

    def state(self) -> dict[str, Array]:
        """Weights, second moments and number of updates: all that learning depends on."""

    def restore(self, state: Mapping[str, Array]) -> None:
        """Go on from a `state`."""


def build_learner(
    network: NetworkSpec, madam: MadamSpec, n_in: int, n_out: int, seed: int
) -> Learner:
    """The learner that a scenario asks for; the same seed gives both backends the same weights."""
    shape = network_shape(network, n_in, n_out)
    weights = initial_weights(shape, network, np.random.default_rng(seed))
    if network.backend == "torch":
        return TorchLearner(shape, weights, madam)
    weights = weights.astype(network.precision)
    warm_up(weights.dtype)
    return KernelLearner(shape, weights, madam)


class _CompileNotice(event.Listener):
    """Says once, on standard error, why the first run of all takes seconds longer."""

    def __init__(self) -> None:
        self._said = False

    def on_start(self, event: event.Event) -> None:
        if not self._said:
            self._said = True
            print("compiling the network kernel; later runs load it", file=sys.stderr, flush=True)

    def on_end(self, event: event.Event) -> None:
        pass


def warm_up(precision: np.dtype) -> None:
    """Compile the kernel, or load it compiled, so that no tick of a run pays for it."""
    shape = Shape((1, 1), bias=True, activation="sigmoid")
    with event.install_listener("numba:compile", _CompileNotice()):
        tiny = KernelLearner(shape, np.ones(2, precision), MadamSpec())
        tiny.predict(np.ones(1))
        tiny.learn(np.ones(1))


class KernelLearner:
    """The compiled backend.

    Args:
        shape: layer sizes.
        weights: flat initial weights (n_weights,), float64 or float32, which is the precision that
            the network learns in; taken over.
        spec: Madam's parameters.
    """

    def __init__(self, shape: Shape, weights: Array, spec: MadamSpec) -> None:
        self.shape, self.spec = shape, spec
        self.monitors = Monitors.zeros(shape.n_layers)
        self._w, self._v = weights, np.zeros_like(weights)
        self._updates = 0
        self._sizes = np.array(shape.sizes)
        self._activation = kernel.ACTIVATIONS[shape.activation]
        self._acts = np.zeros(kernel.activations_size(shape.sizes), weights.dtype)
        self._deltas = np.zeros_like(self._acts)
        out = self._acts.size - shape.sizes[-1] - 1
        self._output, self._delta = self._acts[out:-1], self._deltas[out:-1]
        self._stats = np.zeros((shape.n_layers, 5))
        most, tiny = spec.eta_max / spec.eta, float(np.finfo(weights.dtype).tiny)
        madam = [spec.eta, most, spec.sigma_max, spec.beta, 1.0, tiny]
        self._madam = np.array(madam, weights.dtype)
        self._x = np.zeros(shape.sizes[0], weights.dtype)
        self._prediction = np.zeros(shape.sizes[-1])
        self._before, self._after = np.zeros_like(weights), np.zeros_like(weights)

    def predict(self, x: Array) -> Array:
        self._x[:] = x
        self._forward()
        self._prediction[:] = self._output
        return self._prediction

    def learn(self, delta: Array) -> None:
        shape = self.shape
        self._delta[:] = delta
        sampled = self._updates % GRADIENT_CHANGE_EVERY == 0
        if sampled:
            self._gradient(self._before)
        self._updates += 1
        if self.spec.bias_correction:
            self._madam[4] = 1.0 / (1.0 - self.spec.beta**self._updates)
        kernel.learn(
            self._w, self._v, self._sizes, shape.bias, self._activation,
            self._acts, self._deltas, self._madam, self._stats,
        )  # fmt: skip
        update_monitors(self.monitors, self._stats)
        if sampled:
            self._measure_gradient_change()

    def _forward(self) -> None:
        bias, code = self.shape.bias, self._activation
        kernel.forward(self._w, self._sizes, bias, code, self._x, self._acts)

    def _gradient(self, g: Array) -> None:
        kernel.gradient(
            self._w, self._sizes, self.shape.bias, self._activation, self._acts, self._deltas, g
        )

    def _measure_gradient_change(self) -> None:
        self._forward()
        self._gradient(self._after)
        self.monitors.gradient_change[:] = gradient_change(self.shape, self._before, self._after)

    def state(self) -> dict[str, Array]:
        return {
            "weights": self._w.copy(),
            "second_moment": self._v.copy(),
            "updates": np.array(self._updates),
            "gradient_change": self.monitors.gradient_change.copy(),
        }

    def restore(self, state: Mapping[str, Array]) -> None:
        self._w[:] = state["weights"]
        self._v[:] = state["second_moment"]
        self._updates = int(state["updates"])
        self.monitors.gradient_change[:] = state["gradient_change"]


class TorchLearner:
    """The reference backend: torch's autograd and optimiser. Slow, and obvious.

    Args:
        shape: layer sizes.
        weights: flat initial weights (n_weights,); copied.
        spec: Madam's parameters.
    """

    def __init__(self, shape: Shape, weights: Array, spec: MadamSpec) -> None:
        try:
            import torch
        except ImportError as error:
            raise MissingExtraError(
                "controller.network.backend = torch needs torch, which is not installed; "
                "pip install 'dnnmso_mj[reference]', or use backend: kernel"
            ) from error
        from dnnmso_mj.madam import Madam

        self._torch = torch
        self.shape, self.spec = shape, spec
        self.monitors = Monitors.zeros(shape.n_layers)
        self.network = TorchNetwork(shape, weights)
        self.optimizer = Madam(self.network.parameters, spec)
        self._x = torch.zeros(shape.sizes[0], dtype=torch.float64)
        self._output = self._x
        self._updates = 0

    def predict(self, x: Array) -> Array:
        self._x = self._torch.tensor(x, dtype=self._torch.float64)
        self._output = self.network(self._x)
        prediction: Array = self._output.detach().numpy().copy()
        return prediction

    def learn(self, delta: Array) -> None:
        before, w = self._backward(delta), self.network.flat()
        self.optimizer.step()
        update_monitors(self.monitors, self._sums(w, before))
        if self._updates % GRADIENT_CHANGE_EVERY == 0:
            self._output = self.network(self._x)
            after = self._backward(delta)
            self.monitors.gradient_change[:] = gradient_change(self.shape, before, after)
        self._updates += 1

    def _backward(self, delta: Array) -> Array:
        self.optimizer.zero_grad()
        self._torch.autograd.backward(
            self._output, self._torch.tensor(delta, dtype=self._torch.float64)
        )
        return self.network.flat_gradient()

    def _sums(self, w: Array, g: Array) -> Array:
        """The (L, 5) sums of `kernel.learn`."""
        new = self.network.flat()
        second_moments = [self.optimizer.state[W]["g_bar_sq"] for W in self.network.parameters]
        v = np.concatenate([moment.numpy().ravel() for moment in second_moments])
        beta, eta, most = self.spec.beta, self.spec.eta, self.spec.eta_max / self.spec.eta
        correction = 1 - beta ** (self._updates + 1) if self.spec.bias_correction else 1.0
        ratio = np.divide(g, np.sqrt(v / correction), out=np.zeros_like(g), where=v > 0)
        grown = w * np.exp(-eta * np.sign(w) * np.clip(ratio, -most, most))
        clipped = (np.abs(ratio) > most) | (np.abs(grown) > self.spec.sigma_max)
        columns = [w * w, g * g, np.abs(g * w), (new - w) ** 2, clipped.astype(float)]
        layers = zip(*(self.shape.split(column) for column in columns), strict=True)
        return np.array([[matrix.sum() for matrix in layer] for layer in layers])

    def state(self) -> dict[str, Array]:
        moments = [
            self.optimizer.state[W].get("g_bar_sq", self._torch.zeros_like(W))
            for W in self.network.parameters
        ]
        return {
            "weights": self.network.flat(),
            "second_moment": np.concatenate([m.numpy().ravel() for m in moments]),
            "updates": np.array(self._updates),
            "gradient_change": self.monitors.gradient_change.copy(),
        }

    def restore(self, state: Mapping[str, Array]) -> None:
        weights = self.shape.split(state["weights"])
        moments = self.shape.split(state["second_moment"])
        self._updates = int(state["updates"])
        with self._torch.no_grad():
            for W, value, moment in zip(self.network.parameters, weights, moments, strict=True):
                W.copy_(self._torch.tensor(value))
                g_bar_sq = self._torch.tensor(moment)
                self.optimizer.state[W].update(k=self._updates, g_bar_sq=g_bar_sq)
        self.monitors.gradient_change[:] = state["gradient_change"]


def update_monitors(monitors: Monitors, sums: Array) -> None:
    """Fill the monitors from the (L, 5) sums of one update.

    Raises:
        NonFiniteError: a weight or a gradient of the update was not finite.
    """
    monitors.drt_bound, clipped = layer_monitors(
        sums, monitors.weight_norm, monitors.update_ratio, monitors.eta_bound
    )
    monitors.clipped = clipped > 0.0
    if not math.isfinite(sums.sum()):
        layer, column = (int(i) for i in np.argwhere(~np.isfinite(sums))[0])
        what = ("weights", "gradient", "gradient times weights", "weight update")[column]
        raise NonFiniteError(f"{what} of layer {layer + 1}", float(sums[layer, column]))


def gradient_change(shape: Shape, before: Array, after: Array) -> Array:
    """‖g_l(W+ΔW) − g_l(W)‖/‖g_l(W)‖ (L,) of flat gradients; 0 where a layer has no gradient."""
    out = np.zeros(shape.n_layers)
    pairs = zip(shape.split(before), shape.split(after), strict=True)
    for layer, (old, new) in enumerate(pairs):
        norm = np.linalg.norm(old)
        if norm > 0:
            out[layer] = np.linalg.norm(new - old) / norm
    return out
