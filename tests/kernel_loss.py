"""The kernel's output, loss and gradient for any flat weights, in float64."""

from __future__ import annotations

import numpy as np

from dnnmso_mj import kernel
from dnnmso_mj.network import Shape
from dnnmso_mj.scenario import Madam


def last_output(net: kernel.Net) -> np.ndarray:
    """f̂ (n_out,) of the network's last `forward`, as a copy."""
    start = kernel.output_at(net)
    return net.acts[start : start + net.layers[-1, kernel.N_OUT]].copy()


def output(net: kernel.Net, x: np.ndarray) -> np.ndarray:
    """f̂(x) (n_out,)."""
    kernel.forward(net, x)
    return last_output(net)


def loss_and_gradient(
    shape: Shape, w: np.ndarray, x: np.ndarray, delta: np.ndarray
) -> tuple[float, np.ndarray]:
    """ℓ(W) = δᵀ f̂(x; W) and ∂ℓ/∂W (n_weights,)."""
    net = kernel.build_net(shape, w, Madam())
    loss = float(delta @ output(net, x))
    last = kernel.output_at(net)
    net.deltas[last : last + delta.size] = delta
    g = np.zeros_like(net.w)
    kernel.gradient(net, g)
    return loss, kernel.unpack(shape, g)
