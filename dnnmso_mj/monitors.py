"""What learning does to the network: watched for ten updates, then one in ten.

Watching needs the gradient as a vector and a second backward pass, more work than the update
itself, and changes nothing: the trajectory is the same with and without. Between two looks
the last values are held. Every update that Madam may clamp is looked at: |g/ḡ|, at most 1/√(1 − β),
would have to exceed η*/η, or a weight to be near σ*. No other rule clamps.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dnnmso_mj import kernel
from dnnmso_mj.compiling import compiled, copy, inner
from dnnmso_mj.descent import MADAM
from dnnmso_mj.kernel import END, START, Net
from dnnmso_mj.scenario import Madam as MadamSpec
from dnnmso_mj.scenario import Rule
from dnnmso_mj.theory import CLIPPED, DW_SQ, G_SQ, GW, W_SQ, layer_monitors

Array = np.ndarray

WATCH_EVERY = 10  # updates


class Monitors(NamedTuple):
    """Per layer (L,), and for the whole network (1,); see `theory` for what they mean."""

    weight_norm: Array
    update_ratio: Array
    eta_bound: Array
    gradient_change: Array
    drt_bound: Array
    clipped: Array  # 1.0 if this update was clamped; exact on every tick

    @classmethod
    def zeros(cls, n_layers: int) -> Monitors:
        """Monitors before the first update; empty without a network."""
        return cls(*np.zeros((4, n_layers)), *np.zeros((2, 1)))


class Watch(NamedTuple):
    """Memory for looking at one update."""

    w: Array  # weights before it, and the gradients before and after it, in the kernel's order
    g: Array
    g_after: Array
    stats: Array  # (L, 5)
    clamp_norm: float  # see `clamp_norm`
    never: bool


def build_watch(net: Net, spec: Rule, on: bool) -> Watch:
    """What `learn` needs to watch a network, or to leave it alone."""
    w, g, g_after = np.zeros((3, net.w.size), net.w.dtype)
    stats = np.zeros((len(net.layers), 5))
    return Watch(w, g, g_after, stats, clamp_norm=clamp_norm(spec), never=not on)


def clamp_norm(spec: Rule) -> float:
    """‖W_l‖ above which an update may be clamped before the next sample; −1 where each may be."""
    if not isinstance(spec, MadamSpec):
        return math.inf
    if spec.eta_max < 1.001 * spec.eta / math.sqrt(1.0 - spec.beta):  # room for rounding
        return -1.0
    return spec.sigma_max * math.exp(-(WATCH_EVERY + 1) * spec.eta_max)


@compiled
def is_due(updates: int, clamp_norm: float, weight_norm: Array) -> bool:
    """Whether the next update is looked at, after so many and with the last ‖W_l‖ (L,)."""
    due = updates < WATCH_EVERY or updates % WATCH_EVERY == 0  # the first steps are the boldest
    for norm in weight_norm:
        due = due or norm > clamp_norm
    return due


@compiled
def learn(net: Net, watch: Watch, monitors: Monitors) -> None:
    """One `kernel.learn`, watched when it is due."""
    sampled = net.updates[0] % WATCH_EVERY == 0
    if watch.never or not is_due(net.updates[0], watch.clamp_norm, monitors.weight_norm):
        monitors.clipped[0] = 0.0
        kernel.learn(net)
        return
    copy(net.w, watch.w)
    kernel.gradient(net, watch.g)
    kernel.learn(net)
    _sum_up(net, watch)
    monitors.drt_bound[0], clipped = layer_monitors(
        watch.stats, monitors.weight_norm, monitors.update_ratio, monitors.eta_bound
    )
    monitors.clipped[0] = 1.0 if clipped > 0.0 else 0.0
    if sampled:
        kernel.propagate(net)
        kernel.gradient(net, watch.g_after)
        _gradient_change(net, watch, monitors.gradient_change)


@inner
def _span(net: Net, layer: int) -> slice:
    return slice(net.layers[layer, START], net.layers[layer, END])


@inner
def _sum_up(net: Net, watch: Watch) -> None:
    """Σw², Σg², Σ|g||w|, ΣΔw² and the number of clamped updates of each layer into `stats`."""
    for layer in range(len(net.layers)):
        span = _span(net, layer)
        _sum_layer(watch.w[span], watch.g[span], net.w[span], watch.stats[layer])
    if net.rule == MADAM:
        _count_clamps(net, watch)


@inner
def _count_clamps(net: Net, watch: Watch) -> None:
    """The number of clamped updates of each layer into `stats`."""
    eta, eta_max, sigma_max, beta = net.settings
    correction = 1.0 - beta ** net.updates[0] if net.bias_correction else 1.0
    most_sq = (eta_max / eta) ** 2 / correction
    for layer in range(len(net.layers)):
        span = _span(net, layer)
        clamped = _count_clamped(watch.g[span], net.w[span], net.v[span], most_sq, sigma_max)
        watch.stats[layer, CLIPPED] = clamped


@compiled
def _sum_layer(before: Array, g: Array, after: Array, sums: Array) -> None:
    w_sq = g_sq = gw = dw_sq = 0.0
    for i in range(before.size):
        w, gradient = float(before[i]), float(g[i])
        change = float(after[i]) - w
        w_sq += w * w
        g_sq += gradient * gradient
        gw += abs(gradient * w)
        dw_sq += change * change
    sums[W_SQ], sums[G_SQ], sums[GW], sums[DW_SQ] = w_sq, g_sq, gw, dw_sq


@compiled
def _count_clamped(g: Array, w: Array, v: Array, most_sq: float, sigma_max: float) -> float:
    """How many have |g/ḡ| > η*/η or |w| = σ*."""
    most, limit, count = w.dtype.type(most_sq), w.dtype.type(sigma_max), 0
    for i in range(w.size):
        count += (g[i] * g[i] > most * v[i]) | (abs(w[i]) >= limit)
    return float(count)


@inner
def _gradient_change(net: Net, watch: Watch, out: Array) -> None:
    """‖g_l(W+ΔW) − g_l(W)‖/‖g_l(W)‖ (L,); 0 where a layer has no gradient."""
    for layer in range(len(net.layers)):
        span = _span(net, layer)
        out[layer] = _turn(watch.g[span], watch.g_after[span])


@compiled
def _turn(before: Array, after: Array) -> float:
    old = turned = 0.0
    for i in range(before.size):
        g = float(before[i])
        old += g * g
        turned += (float(after[i]) - g) ** 2
    return math.sqrt(turned / old) if old > 0.0 else 0.0
