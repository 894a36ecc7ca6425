"""The network, its gradient and Madam's update, fused into compiled passes over flat arrays.

`forward` leaves every layer's activations behind; `learn` walks back through them once and, while a
weight is in hand, passes the error back through it and updates it. Nothing is allocated. The torch
reference is `dnnmso_mj.network` with `dnnmso_mj.madam`.

A layer's weights are stored by input: the weights of one input to all neurons stand side by side
(the constant input last), padded with zeros to a whole number of vector registers. A weight of zero
under Madam stays zero, and its error and output are never read, so padding is inert.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import compiled, copy, inner
from dnnmso_mj.network import Activation, Shape
from dnnmso_mj.scenario import Madam as MadamSpec

Array = np.ndarray

ACTIVATIONS: dict[Activation, int] = {"sigmoid": 0, "tanh": 1, "relu": 2}
LANES = 16  # padding of a layer's width: one 512-bit register of float32
SHORT = 0.1  # |exponent| up to which a short polynomial is the exponential

# Columns of `stats`, a row for each layer.
W_SQ, G_SQ, GW, DW_SQ, CLIPPED = range(5)


class Net(NamedTuple):
    """A network and its optimiser, ready for the compiled passes; w to deltas in its precision."""

    w: Array  # weights in the kernel's order
    v: Array  # their second moments ḡ²
    acts: Array  # every layer's activations, the constant input behind each
    deltas: Array  # ∂loss/∂(input sum) of every layer; the last one is set by the caller
    sizes: Array  # (L+1,) widths
    strides: Array  # (L,) padded widths of the layers' outputs
    starts: Array  # (L,) where a layer's weights begin
    slots: Array  # (L+1,) where a layer's activations and deltas begin
    madam: Array  # η, η*, σ*, β; float64
    updates: Array  # (1,) number of updates so far
    bias: int  # 1 with a constant input to every layer, else 0
    activation: int
    bias_correction: bool


def build_net(shape: Shape, weights: Array, spec: MadamSpec) -> Net:
    """A network with the given flat weights (n_weights,), whose precision becomes its own."""
    dtype = weights.dtype
    padded = [-(-size // LANES) * LANES for size in shape.sizes]
    rows = [n_in + shape.bias for n_in in shape.sizes[:-1]]
    lengths = [n * stride for n, stride in zip(rows, padded[1:], strict=True)]
    slots = np.cumsum([0] + [size + LANES for size in padded])
    net = Net(
        w=np.zeros(sum(lengths), dtype),
        v=np.zeros(sum(lengths), dtype),
        acts=np.zeros(slots[-1], dtype),
        deltas=np.zeros(slots[-1], dtype),
        sizes=np.array(shape.sizes),
        strides=np.array(padded[1:]),
        starts=np.cumsum([0, *lengths])[:-1],
        slots=slots[:-1],
        madam=np.array([spec.eta, spec.eta_max, spec.sigma_max, spec.beta]),
        updates=np.zeros(1, int),
        bias=int(shape.bias),
        activation=ACTIVATIONS[shape.activation],
        bias_correction=spec.bias_correction,
    )
    net.w[:] = pack(net, shape, weights)
    return net


def pack(net: Net, shape: Shape, flat: Array) -> Array:
    """Flat (n_weights,) values, matrix after matrix as in `Shape`, in the kernel's order."""
    packed = np.zeros_like(net.w)
    for W, matrix in zip(_layers(net, packed), shape.split(flat), strict=True):
        W[:, : matrix.shape[0]] = matrix.T
    return packed


def unpack(net: Net, shape: Shape, packed: Array) -> Array:
    """The inverse of `pack`, as a new array."""
    matrices = zip(_layers(net, packed), shape.matrices, strict=True)
    return np.concatenate([W[:, :n_out].T.ravel() for W, (n_out, _) in matrices])


def _layers(net: Net, packed: Array) -> list[Array]:
    """Views of a packed vector as the layers' (n_in + bias, stride) matrices."""
    ends = [*net.starts[1:], packed.size]
    spans = zip(net.starts, ends, net.strides, strict=True)
    return [packed[start:end].reshape(-1, stride) for start, end, stride in spans]


@compiled
def forward(net: Net, x: Array) -> Array:
    """f̂(x) for x (n_in,): a view (n_out,) of the last activations."""
    copy(x, net.acts)
    return propagate(net)


@compiled
def propagate(net: Net) -> Array:
    """`forward` once more, with the x it had."""
    acts, n_layers = net.acts, net.strides.size
    real = acts.dtype.type
    for layer in range(n_layers):
        n_in, stride = net.sizes[layer], net.strides[layer]
        at, out, start = net.slots[layer], net.slots[layer + 1], net.starts[layer]
        acts[at + n_in] = 1.0
        z = acts[out : out + stride]
        for i in range(stride):
            z[i] = real(0.0)
        for j in range(n_in + net.bias):
            a, row = acts[at + j], net.w[start + j * stride : start + (j + 1) * stride]
            for i in range(stride):
                z[i] += a * row[i]
        if layer < n_layers - 1:
            _activate(z, net.activation)
    last = net.slots[n_layers]
    return acts[last : last + net.sizes[n_layers]]


@inner
def _activate(z: Array, activation: int) -> None:
    """σ(z) in place."""
    one, zero = z.dtype.type(1.0), z.dtype.type(0.0)
    if activation == 0:
        for i in range(z.size):
            z[i] = one / (one + math.exp(-z[i]))
    elif activation == 1:
        for i in range(z.size):
            z[i] = math.tanh(z[i])
    else:
        for i in range(z.size):
            z[i] = max(z[i], zero)


@inner
def _slope(activation: int, a: float, real: type[float]) -> float:
    """σ'(z) from a = σ(z); `real` keeps float32 from widening."""
    one = real(1.0)
    if activation == 0:
        return a * (one - a)
    if activation == 1:
        return one - a * a
    return one if a > real(0.0) else real(0.0)


@inner
def _exp_single(x: float, real: type[float]) -> float:
    """exp(−x) for |x| ≤ 1/8 to float32's precision, without a call, so that loops vectorise."""
    p = real(1 / 24) - x * real(1 / 120)
    return real(1) - x * (real(1) - x * (real(1 / 2) - x * (real(1 / 6) - x * p)))


@inner
def _exp_double(x: float, real: type[float]) -> float:
    """exp(−x) for |x| ≤ 1/8 to 3e-14, likewise."""
    p = real(1 / 720) - x * (real(1 / 5040) - x * real(1 / 40320))
    p = real(1 / 6) - x * (real(1 / 24) - x * (real(1 / 120) - x * p))
    return real(1) - x * (real(1) - x * (real(1 / 2) - x * p))


@inner
def _madam_row(
    w: Array, v: Array, delta: Array, a: float, beta: float, rate: float, most: float, limit: float
) -> float:
    """Update the weights of one input and return the error that they pass back to it.

    Args:
        a: the input times √(1 − β), so that a·delta is √(1 − β) g.
        rate, most: η and η*/η for a ratio g/ḡ that is small by √(1 − β).
        limit: σ*.
    """
    real = w.dtype.type
    single = np.finfo(w.dtype).eps > 1e-10
    short = rate * most <= real(SHORT)
    tiny = np.finfo(w.dtype).tiny  # stands for ḡ² = 0, so that 0/0 is no update
    back: float = real(0.0)
    for i in range(w.size):
        wi = w[i]
        back += wi * delta[i]
        g = delta[i] * a
        vi = g * g + beta * v[i]
        v[i] = vi
        ratio = g / math.sqrt(max(vi, tiny))
        # A weight of zero stays zero, whatever sign copysign gives it.
        x = math.copysign(rate, wi) * min(max(ratio, -most), most)
        if short:
            growth = _exp_single(x, real) if single else _exp_double(x, real)
        else:
            x *= real(0.125)
            growth = _exp_single(x, real) if single else _exp_double(x, real)
            growth *= growth
            growth *= growth
            growth *= growth
        w[i] = min(max(wi * growth, -limit), limit)
    return back


@compiled
def learn(net: Net) -> None:
    """Back-propagate and update every weight once (Alg. 1), in place.

    The activations are those of the last `forward`; the output's deltas hold ∂loss/∂f̂.
    """
    real, n_layers = net.w.dtype.type, net.strides.size
    eta, eta_max, sigma_max, beta = net.madam
    net.updates[0] += 1
    correction = 1.0 - beta ** net.updates[0] if net.bias_correction else 1.0
    small = math.sqrt((1.0 - beta) / correction)
    fresh, forget, limit = real(math.sqrt(1.0 - beta)), real(beta), real(sigma_max)
    rate, most = real(eta / small), real(eta_max / eta * small)
    for layer in range(n_layers - 1, -1, -1):
        n_in, stride = net.sizes[layer], net.strides[layer]
        at, out, start = net.slots[layer], net.slots[layer + 1], net.starts[layer]
        delta = net.deltas[out : out + stride]
        for j in range(n_in + net.bias):
            row, a = start + j * stride, net.acts[at + j]
            w, v = net.w[row : row + stride], net.v[row : row + stride]
            back = _madam_row(w, v, delta, a * fresh, forget, rate, most, limit)
            if j < n_in:
                net.deltas[at + j] = back * _slope(net.activation, a, real)


@compiled
def gradient(net: Net, g: Array) -> None:
    """∂loss/∂w into `g`, in the kernel's order and without any update; otherwise as `learn`."""
    real, n_layers = net.w.dtype.type, net.strides.size
    for layer in range(n_layers - 1, -1, -1):
        n_in, stride = net.sizes[layer], net.strides[layer]
        at, out, start = net.slots[layer], net.slots[layer + 1], net.starts[layer]
        delta = net.deltas[out : out + stride]
        for j in range(n_in + net.bias):
            row, a = start + j * stride, net.acts[at + j]
            w, gj = net.w[row : row + stride], g[row : row + stride]
            back = real(0.0)
            for i in range(stride):
                back += w[i] * delta[i]
                gj[i] = a * delta[i]
            if j < n_in:
                net.deltas[at + j] = back * _slope(net.activation, a, real)
