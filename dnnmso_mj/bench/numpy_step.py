"""The control step in NumPy: backward pass by hand, one weight vector, nothing large allocated."""

from __future__ import annotations

import numpy as np

from dnnmso_mj.network import Shape
from dnnmso_mj.scenario import Madam as MadamSpec

Array = np.ndarray


class NumpyStep:
    """A sigmoid network with biases that learns one sample a call by Madam.

    Args:
        shape: layer sizes.
        weights: flat initial weights (n_weights,), copied; their precision becomes the network's.
        spec: Madam's parameters.
    """

    def __init__(self, shape: Shape, weights: Array, spec: MadamSpec) -> None:
        self._spec, self._most = spec, spec.eta_max / spec.eta
        w = self._w = weights.copy()
        self._v, self._g, self._ratio, self._scratch = (np.zeros_like(w) for _ in range(4))
        self._tiny = np.finfo(w.dtype).tiny
        self._W, self._G = shape.split(w), shape.split(self._g)
        self._WT = [W[:, :-1].T for W in self._W]
        # The constant input stands behind each layer's activations.
        self._inputs = [np.ones(size + 1, w.dtype) for size in shape.sizes[:-1]]
        self._acts = [inputs[:-1] for inputs in self._inputs]
        self._acts.append(np.zeros(shape.sizes[-1], w.dtype))

    def predict(self, x: Array) -> Array:
        """Output (n_out,) for x (n_in,); overwritten by the next call."""
        self._acts[0][:] = x
        last = len(self._W) - 1
        for k, (W, inputs) in enumerate(zip(self._W, self._inputs, strict=True)):
            out = np.dot(W, inputs, out=self._acts[k + 1] if k == last else None)
            if k < last:
                np.negative(out, out=out)
                np.exp(out, out=out)
                out += 1.0
                np.reciprocal(out, out=self._acts[k + 1])
        return self._acts[-1]

    def learn(self, delta: Array) -> None:
        """One update from ∂loss/∂output (n_out,)."""
        for k in range(len(self._W) - 1, -1, -1):
            np.multiply(delta[:, None], self._inputs[k], out=self._G[k])
            if k > 0:
                a = self._acts[k]
                delta = np.dot(self._WT[k], delta)
                delta *= a * (1.0 - a)
        self._update()

    def _update(self) -> None:
        spec, w, v, g, ratio, scratch = (
            self._spec, self._w, self._v, self._g, self._ratio, self._scratch,
        )  # fmt: skip
        np.multiply(g, g, out=scratch)
        scratch *= 1.0 - spec.beta
        v *= spec.beta
        v += scratch
        np.sqrt(v, out=ratio)
        np.maximum(ratio, self._tiny, out=ratio)
        np.divide(g, ratio, out=ratio)
        np.clip(ratio, -self._most, self._most, out=ratio)
        ratio *= np.sign(w, out=scratch)
        ratio *= -spec.eta
        w *= np.exp(ratio, out=ratio)
        np.clip(w, -spec.sigma_max, spec.sigma_max, out=w)

    def weights(self) -> Array:
        """All weights, flat, as given."""
        return self._w.copy()
