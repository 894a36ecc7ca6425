"""The kernel's loss and gradient for any flat weights, in float64."""

from __future__ import annotations

import numpy as np

from dnnmso_mj import kernel
from dnnmso_mj.network import Shape
from dnnmso_mj.scenario import Madam


def loss_and_gradient(
    shape: Shape, w: np.ndarray, x: np.ndarray, delta: np.ndarray
) -> tuple[float, np.ndarray]:
    """ℓ(W) = δᵀ f̂(x; W) and ∂ℓ/∂W (n_weights,)."""
    net = kernel.build_net(shape, w, Madam())
    loss = float(delta @ kernel.forward(net, x))
    last = kernel.output_at(net)
    net.deltas[last : last + delta.size] = delta
    g = np.zeros_like(net.w)
    kernel.gradient(net, g)
    return loss, kernel.unpack(shape, g)
