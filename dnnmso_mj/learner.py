"""A network that learns one sample a tick, called from Python.

Two backends with one interface: the compiled kernel, and torch's autograd (`torch_learner`) as the
reference. A tick is `predict`, then `learn` with the gradient of the loss by the network's output.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Protocol

import numpy as np

from dnnmso_mj import kernel, monitors
from dnnmso_mj.errors import NonFiniteError
from dnnmso_mj.monitors import Monitors
from dnnmso_mj.network import Shape, initial_weights, network_shape
from dnnmso_mj.scenario import Network as NetworkSpec
from dnnmso_mj.scenario import Rule

Array = np.ndarray


class Learner(Protocol):
    """A network trained online."""

    shape: Shape
    monitors: Monitors

    def predict(self, x: Array) -> Array:
        """Output (n_out,) for input x (n_in,); overwritten by the next call."""

    def learn(self, delta: Array) -> None:
        """One update from ∂loss/∂output (n_out,) at the last predicted input."""

    def state(self) -> dict[str, Array]:
        """Weights, moments, number of updates and monitors held: all that comes after."""

    def restore(self, state: Mapping[str, Array]) -> None:
        """Go on from a `state`."""


def build_learner(
    network: NetworkSpec, rule: Rule, n_in: int, n_out: int, seed: int, *, watch: bool = True
) -> Learner:
    """The learner that a scenario asks for; the same seed gives both backends the same weights.

    Args:
        rule: what updates the weights: the settings of Madam or of another.
        watch: whether the monitors are kept; they change nothing in what is learned.
    """
    shape = network_shape(network, n_in, n_out)
    weights = initial_weights(shape, network, np.random.default_rng(seed))
    weights = weights.astype(network.precision)
    if network.backend == "torch":
        from dnnmso_mj.torch_learner import TorchLearner

        return TorchLearner(shape, weights, rule)
    return KernelLearner(shape, weights, rule, watch=watch)


class KernelLearner:
    """The compiled backend.

    Args:
        shape: layer sizes.
        weights: flat initial weights (n_weights,), float64 or float32, which is the precision that
            the network learns in; copied.
        spec: the rule that updates the weights.
        watch: whether the monitors are kept.
    """

    def __init__(self, shape: Shape, weights: Array, spec: Rule, *, watch: bool = True) -> None:
        self.shape = shape
        self.net = kernel.build_net(shape, weights, spec)
        self.watch = monitors.build_watch(self.net, spec, watch)
        self.monitors = Monitors.zeros(shape.n_layers)
        out = kernel.output_at(self.net)
        self._output = self.net.acts[out : out + shape.sizes[-1]]
        self._delta = self.net.deltas[out : out + shape.sizes[-1]]
        self._prediction = np.zeros(shape.sizes[-1])

    def predict(self, x: Array) -> Array:
        kernel.forward(self.net, x)
        self._prediction[:] = self._output
        return self._prediction

    def learn(self, delta: Array) -> None:
        if not math.isfinite(delta.sum()):
            raise NonFiniteError("gradient of the output", delta.tolist())
        self._delta[:] = delta
        monitors.learn(self.net, self.watch, self.monitors)

    def state(self) -> dict[str, Array]:
        return {
            "weights": kernel.unpack(self.shape, self.net.w),
            "second_moment": kernel.unpack(self.shape, self.net.v),
            **({"first_moment": kernel.unpack(self.shape, self.net.m)} if self.net.m.size else {}),
            "updates": self.net.updates.copy(),
            **held(self.monitors),
        }

    def restore(self, state: Mapping[str, Array]) -> None:
        self.net.w[:] = kernel.pack(self.shape, state["weights"])
        self.net.v[:] = kernel.pack(self.shape, state["second_moment"])
        if self.net.m.size:
            self.net.m[:] = kernel.pack(self.shape, state["first_moment"])
        self.net.updates[:] = state["updates"]
        hold(self.monitors, state)


def held(values: Monitors) -> dict[str, Array]:
    """The monitors as arrays of a state."""
    return {name: array.copy() for name, array in values._asdict().items()}


def hold(values: Monitors, state: Mapping[str, Array]) -> None:
    """Put a state's monitors back."""
    for name, array in values._asdict().items():
        array[:] = state[name]
