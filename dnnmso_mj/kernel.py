"""The network, its gradient and Madam's update, fused into compiled passes over flat arrays.

`forward` leaves every layer's activations behind; `learn` walks back through them once, and while a
weight is in hand forms its gradient, its second moment, its update and the sums that theory needs.
Nothing is allocated. The torch reference is `dnnmso_mj.network` with `dnnmso_mj.madam`.

Arrays, all float64 or all float32: `w`, `v` flat weights and second moments ḡ²; `acts` the
activations of all layers with each layer's constant input behind it, `deltas` likewise. `sizes`
(L+1,) are the layer widths.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from dnnmso_mj.network import Activation

Array = np.ndarray

ACTIVATIONS: dict[Activation, int] = {"sigmoid": 0, "tanh": 1, "relu": 2}

# Columns of `stats`, a row for each layer.
W_SQ, G_SQ, GW, DW_SQ, CLIPPED = range(5)

# Reassociation lets sums vectorise; NaN and infinity keep their meaning, for they must be caught.
compiled = njit(
    cache=True,
    nogil=True,
    error_model="numpy",
    fastmath={"reassoc", "contract", "arcp", "nsz"},
)


def activations_size(sizes: tuple[int, ...]) -> int:
    """Length of `acts`: one slot more than its width for each layer."""
    return sum(sizes) + len(sizes)


@compiled
def forward(w: Array, sizes: Array, bias: bool, activation: int, x: Array, acts: Array) -> int:
    """Run the network on x (n_in,). Returns where its output begins in `acts`."""
    n_layers = sizes.size - 1
    extra = 1 if bias else 0
    real = w.dtype.type
    acts[: sizes[0]] = x
    acts[sizes[0]] = 1.0
    a, start = 0, 0
    for layer in range(n_layers):
        n_out, columns = sizes[layer + 1], sizes[layer] + extra
        out = a + sizes[layer] + 1
        inputs = acts[a : a + columns]
        for i in range(n_out):
            row = w[start + i * columns : start + (i + 1) * columns]
            z = real(0.0)
            for j in range(columns):
                z += row[j] * inputs[j]
            if layer == n_layers - 1:
                acts[out + i] = z
            elif activation == 0:
                acts[out + i] = 1.0 / (1.0 + math.exp(-z))
            elif activation == 1:
                acts[out + i] = math.tanh(z)
            else:
                acts[out + i] = max(z, real(0.0))
        acts[out + n_out] = 1.0
        a = out
        start += n_out * columns
    return a


@compiled
def _slope(activation: int, a: float) -> float:
    """σ'(z) from a = σ(z)."""
    if activation == 0:
        return a * (1.0 - a)
    if activation == 1:
        return 1.0 - a * a
    return 1.0 if a > 0.0 else 0.0


@compiled
def _exp(x: float, real: type[float]) -> float:
    """exp(x) for |x| ≤ 1 to 1e-14, without a call, so that the loop around it vectorises.

    `real` is the type of the weights: a plain 1.0 would widen float32 to float64.
    """
    one = real(1.0)
    y = x * real(0.125)
    p = one + y * real(1.0 / 9.0)
    p = one + y * real(1.0 / 8.0) * p
    p = one + y * real(1.0 / 7.0) * p
    p = one + y * real(1.0 / 6.0) * p
    p = one + y * real(1.0 / 5.0) * p
    p = one + y * real(1.0 / 4.0) * p
    p = one + y * real(1.0 / 3.0) * p
    p = one + y * real(1.0 / 2.0) * p
    p = one + y * p
    p = p * p
    p = p * p
    return p * p


@compiled
def _madam_row(
    w: Array, v: Array, inputs: Array, back: Array, delta: float, madam: Array, sums: Array
) -> None:
    """Update one neuron's weights from its error `delta`, and pass the error back through them.

    Args:
        madam: η, η*/η, σ*, β, 1/(1 − βᵏ) or 1 without bias correction, and the smallest normal
            number, which stands for ḡ² = 0 so that 0/0 is no update.
        sums: the layer's row of `stats`.
    """
    real = w.dtype.type
    eta, most, sigma_max, beta = madam[0], madam[1], madam[2], madam[3]
    correction, tiny = madam[4], madam[5]
    fresh = real(1.0) - beta
    w_sq = gw = dw_sq = clipped = real(0.0)
    for j in range(w.size):
        wj = w[j]
        back[j] += wj * delta
        g = delta * inputs[j]
        vj = fresh * (g * g) + beta * v[j]
        v[j] = vj
        ratio = g / math.sqrt(max(vj * correction, tiny))
        step = min(max(ratio, -most), most)
        # A weight of zero stays zero, whatever sign copysign gives it.
        grown = wj * _exp(-math.copysign(eta, wj) * step, real)
        new = min(max(grown, -sigma_max), sigma_max)
        w[j] = new
        change = new - wj
        w_sq += wj * wj
        gw += abs(g * wj)
        dw_sq += change * change
        clipped += abs(step - ratio) + abs(new - grown)
    sums[0] += w_sq
    sums[2] += gw
    sums[3] += dw_sq
    sums[4] += clipped


@compiled
def learn(
    w: Array,
    v: Array,
    sizes: Array,
    bias: bool,
    activation: int,
    acts: Array,
    deltas: Array,
    madam: Array,
    stats: Array,
) -> None:
    """Back-propagate and update every weight once, in place.

    Args:
        acts: as `forward` left it.
        deltas: like `acts`; its output slots hold ∂loss/∂f̂ and stay, the rest is overwritten.
        madam: see `_madam_row`; in the type of w.
        stats: (L, 5) out, float64: Σw², Σg², Σ|g||w|, ΣΔw² and how far updates were clamped, from
            before the update.
    """
    n_layers = sizes.size - 1
    extra = 1 if bias else 0
    start = w.size
    out = acts.size - sizes[n_layers] - 1
    real = w.dtype.type
    stats[:] = 0.0
    for layer in range(n_layers - 1, -1, -1):
        n_out, n_in = sizes[layer + 1], sizes[layer]
        columns = n_in + extra
        start -= n_out * columns
        a = out - n_in - 1
        inputs, back = acts[a : a + columns], deltas[a : a + columns]
        back[:] = 0.0
        delta_sq = 0.0
        for i in range(n_out):
            delta = deltas[out + i]
            if layer < n_layers - 1:
                delta = real(delta * _slope(activation, acts[out + i]))
            delta_sq += delta * delta
            row = start + i * columns
            _madam_row(
                w[row : row + columns],
                v[row : row + columns],
                inputs,
                back,
                delta,
                madam,
                stats[layer],
            )
        inputs_sq = 0.0
        for j in range(columns):
            inputs_sq += inputs[j] * inputs[j]
        stats[layer, G_SQ] = delta_sq * inputs_sq  # g is the outer product of both
        out = a


@compiled
def gradient(
    w: Array,
    sizes: Array,
    bias: bool,
    activation: int,
    acts: Array,
    deltas: Array,
    g: Array,
) -> None:
    """∂loss/∂w (n_weights,) into `g`, without any update; arguments as for `learn`."""
    n_layers = sizes.size - 1
    extra = 1 if bias else 0
    start = w.size
    out = acts.size - sizes[n_layers] - 1
    for layer in range(n_layers - 1, -1, -1):
        n_out, n_in = sizes[layer + 1], sizes[layer]
        columns = n_in + extra
        start -= n_out * columns
        a = out - n_in - 1
        deltas[a : a + columns] = 0.0
        for i in range(n_out):
            delta = deltas[out + i]
            if layer < n_layers - 1:
                delta *= _slope(activation, acts[out + i])
            for j in range(columns):
                k = start + i * columns + j
                deltas[a + j] += w[k] * delta
                g[k] = delta * acts[a + j]
        out = a
