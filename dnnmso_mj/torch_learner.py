"""The reference learner: torch's autograd and optimiser. Slow, and obvious."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from dnnmso_mj.errors import MissingExtraError, NonFiniteError
from dnnmso_mj.learner import held, hold
from dnnmso_mj.monitors import WATCH_EVERY, Monitors, clamp_norm, is_due
from dnnmso_mj.network import Shape, TorchNetwork
from dnnmso_mj.scenario import Madam as MadamSpec
from dnnmso_mj.scenario import Rule
from dnnmso_mj.theory import DW_SQ, G_SQ, GW, W_SQ, layer_monitors

Array = np.ndarray

NAMES = {W_SQ: "weights", G_SQ: "gradient", GW: "gradient times weights", DW_SQ: "weight update"}


class TorchLearner:
    """A `Learner` in torch.

    Args:
        shape: layer sizes.
        weights: flat initial weights (n_weights,), whose precision it learns in; copied.
        spec: the rule that updates the weights.
    """

    def __init__(self, shape: Shape, weights: Array, spec: Rule) -> None:
        try:
            import torch
        except ImportError as error:
            raise MissingExtraError(
                "controller.network.backend = torch needs torch, which is not installed; "
                "pip install 'dnnmso_mj[reference]', or use backend: kernel"
            ) from error
        from dnnmso_mj import torch_optimizers

        self._torch, self._rules = torch, torch_optimizers
        self.shape, self.spec = shape, spec
        self.monitors = Monitors.zeros(shape.n_layers)
        self.network = TorchNetwork(shape, weights)
        self.optimizer = torch_optimizers.build_optimizer(self.network.parameters, spec)
        self._dtype = self.network.parameters[0].dtype
        self._x = torch.zeros(shape.sizes[0], dtype=self._dtype)
        self._output = self._x
        self._updates = 0
        self._clamp_norm = clamp_norm(spec)

    def predict(self, x: Array) -> Array:
        self._x = self._torch.tensor(x, dtype=self._dtype)
        self._output = self.network(self._x)
        prediction: Array = self._output.detach().numpy().astype(float)
        return prediction

    def learn(self, delta: Array) -> None:
        before, w = self._backward(delta), self.network.flat()
        self.optimizer.step()
        sums = self._sums(w, before)
        self._check(sums)
        watched = self.monitors
        watched.clipped[0] = float(sums[:, -1].any())
        if is_due(self._updates, self._clamp_norm, watched.weight_norm):
            watched.drt_bound[0], _ = layer_monitors(
                sums, watched.weight_norm, watched.update_ratio, watched.eta_bound
            )
        if self._updates % WATCH_EVERY == 0:
            self._output = self.network(self._x)
            after = self._backward(delta)
            watched.gradient_change[:] = gradient_change(self.shape, before, after)
        self._updates += 1

    def _backward(self, delta: Array) -> Array:
        self.optimizer.zero_grad()
        self._torch.autograd.backward(self._output, self._torch.tensor(delta, dtype=self._dtype))
        return self.network.flat_gradient()

    def _sums(self, w: Array, g: Array) -> Array:
        """Σw², Σg², Σ|g||w|, ΣΔw² and clamped updates, (L, 5)."""
        w, g, new = w.astype(float), g.astype(float), self.network.flat().astype(float)
        clipped = self._clamped(g, new).astype(float)
        columns = [w * w, g * g, np.abs(g * w), (new - w) ** 2, clipped]
        layers = zip(*(self.shape.split(column) for column in columns), strict=True)
        return np.array([[matrix.sum() for matrix in layer] for layer in layers])

    def _clamped(self, g: Array, new: Array) -> Array:
        """Whether Madam has clamped a ratio or a weight; no other rule does."""
        spec = self.spec
        if not isinstance(spec, MadamSpec):
            return np.zeros(g.size, bool)
        most = spec.eta_max / spec.eta
        correction = 1 - spec.beta ** (self._updates + 1) if spec.bias_correction else 1.0
        bold = g * g > most**2 / correction * self._moments(self._rules.SECOND_MOMENT)
        clamped: Array = bold | (np.abs(new) >= spec.sigma_max)
        return clamped

    def _moments(self, names: Mapping[type[Rule], str]) -> Array:
        """The first or second moments, flat (n_weights,)."""
        name = names.get(type(self.spec))
        moments = [self._rules.moment(self.optimizer, name, W) for W in self.network.parameters]
        return np.concatenate([m.detach().numpy().ravel() for m in moments])

    def _check(self, sums: Array) -> None:
        if not math.isfinite(sums.sum()):
            layer, column = (int(i) for i in np.argwhere(~np.isfinite(sums))[0])
            raise NonFiniteError(f"{NAMES[column]} of layer {layer + 1}", sums[layer, column])

    def state(self) -> dict[str, Array]:
        return {
            "weights": self.network.flat(),
            "second_moment": self._moments(self._rules.SECOND_MOMENT),
            "first_moment": self._moments(self._rules.FIRST_MOMENT),
            "updates": np.array([self._updates]),
            **held(self.monitors),
        }

    def restore(self, state: Mapping[str, Array]) -> None:
        names = ("weights", "first_moment", "second_moment")
        layers = zip(*(self.shape.split(state[name]) for name in names), strict=True)
        self._updates = int(state["updates"][0])
        with self._torch.no_grad():
            for W, values in zip(self.network.parameters, layers, strict=True):
                weights, first, second = (self._torch.tensor(value) for value in values)
                W.copy_(weights)
                self._rules.put_back(self.optimizer, self.spec, W, self._updates, first, second)
        hold(self.monitors, state)


def gradient_change(shape: Shape, before: Array, after: Array) -> Array:
    """‖g_l(W+ΔW) − g_l(W)‖/‖g_l(W)‖ (L,) of flat gradients; 0 where a layer has no gradient."""
    out = np.zeros(shape.n_layers)
    pairs = zip(shape.split(before), shape.split(after), strict=True)
    for layer, (old, new) in enumerate(pairs):
        norm = np.linalg.norm(old)
        if norm > 0:
            out[layer] = np.linalg.norm(new - old) / norm
    return out
