"""The network, its gradient and its update, fused into compiled passes over flat arrays.

`forward` leaves every layer's activations behind; `learn` walks back through them once and, while a
weight is in hand, passes the error back through it and updates it by Madam. For any other rule it
takes the gradient first, and `dnnmso_mj.descent` updates. Nothing is allocated. The torch reference
is `dnnmso_mj.network` with `dnnmso_mj.madam` and `dnnmso_mj.torch_optimizers`.

A layer's weights are stored by input, those of one input to all neurons side by side, or by output,
those of one neuron for all inputs (the constant one last), whichever takes less room when each row
is padded with zeros to whole vector registers. A weight of zero under Madam stays zero, and padding
of inputs and errors is zero, so it is inert; so it is under the other rules, having no gradient.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import compiled, copy, inner, is_finite
from dnnmso_mj.descent import ADAM, MADAM, SGD, SIGN_SGD, descend
from dnnmso_mj.network import Activation, Shape
from dnnmso_mj.scenario import Adam, Rule, Sgd
from dnnmso_mj.scenario import Madam as MadamSpec

Array = np.ndarray

ACTIVATIONS: dict[Activation, int] = {"sigmoid": 0, "tanh": 1, "relu": 2}
LANES = 16  # padding of a layer's width: one 512-bit register of float32
SHORT = 0.1  # |exponent| up to which a short polynomial is the exponential


class Layer(NamedTuple):
    """Where the numbers of a layer stand; a row of `Net.layers`."""

    n_in: int
    n_out: int
    by_output: int  # 1 where a row of weights is a neuron's, 0 where it is an input's
    stride: int  # padded length of a row
    start: int  # of its weights
    end: int
    at: int  # of its inputs in `acts`, and of the errors passed back to them in `deltas`
    out: int  # of its outputs and their errors


N_OUT, START, END, OUT = (Layer._fields.index(n) for n in ("n_out", "start", "end", "out"))


class Net(NamedTuple):
    """A network and its optimiser, ready for the compiled passes; w to deltas in its precision."""

    w: Array  # weights in the kernel's order
    v: Array  # their second moments ḡ²
    m: Array  # their first moments; empty under Madam
    g: Array  # their gradient; empty under Madam, which needs none as a vector
    acts: Array  # every layer's activations, the constant input behind each
    deltas: Array  # ∂loss/∂(input sum) of every layer; the last one is set by the caller
    layers: Array  # (L, 8) `Layer`s, int64
    rule: int  # MADAM, SGD, ADAM or SIGN_SGD
    settings: Array  # (4,) of the rule; η, η*, σ*, β of Madam; float64
    updates: Array  # (1,) number of updates so far
    bias: int  # 1 with a constant input to every layer, else 0
    activation: int
    bias_correction: bool


def build_net(shape: Shape, weights: Array, spec: Rule) -> Net:
    """A network with the given flat weights (n_weights,), whose precision becomes its own."""
    dtype = weights.dtype
    layers = _layers(shape)
    n_acts = layers[-1].out + _padded(layers[-1].n_out) + LANES
    rule, settings = _rule(spec)
    n_moments = 0 if rule == MADAM else layers[-1].end
    net = Net(
        w=np.zeros(layers[-1].end, dtype),
        v=np.zeros(layers[-1].end, dtype),
        m=np.zeros(n_moments, dtype),
        g=np.zeros(n_moments, dtype),
        acts=np.zeros(n_acts, dtype),
        deltas=np.zeros(n_acts, dtype),
        layers=np.array(layers),
        rule=rule,
        settings=np.array(settings),
        updates=np.zeros(1, int),
        bias=int(shape.bias),
        activation=ACTIVATIONS[shape.activation],
        bias_correction=isinstance(spec, MadamSpec) and spec.bias_correction,
    )
    net.w[:] = pack(shape, weights)
    return net


def _rule(spec: Rule) -> tuple[int, tuple[float, float, float, float]]:
    """A rule's number and settings."""
    match spec:
        case MadamSpec():
            return MADAM, (spec.eta, spec.eta_max, spec.sigma_max, spec.beta)
        case Sgd():
            return SGD, (spec.eta, spec.momentum, 0.0, 0.0)
        case Adam():
            return ADAM, (spec.eta, spec.beta1, spec.beta2, spec.eps)
    return SIGN_SGD, (spec.eta, 0.0, 0.0, 0.0)


def _layers(shape: Shape) -> list[Layer]:
    """Each layer stored the way that takes less room."""
    layers: list[Layer] = []
    start = at = 0
    for n_in, n_out in pairwise(shape.sizes):
        inputs = n_in + shape.bias
        by_input, by_output = inputs * _padded(n_out), n_out * _padded(inputs)
        turned = by_output < by_input
        stride, end = _padded(inputs if turned else n_out), start + min(by_input, by_output)
        out = at + _padded(n_in) + LANES
        layers.append(Layer(n_in, n_out, int(turned), stride, start, end, at, out))
        start, at = end, out
    return layers


def _padded(size: int) -> int:
    return -(-size // LANES) * LANES


def pack(shape: Shape, flat: Array) -> Array:
    """Flat (n_weights,) values, matrix after matrix as in `Shape`, in the kernel's order."""
    packed = np.zeros(_layers(shape)[-1].end, flat.dtype)
    for W, matrix in zip(_matrices(shape, packed), shape.split(flat), strict=True):
        W[:] = matrix
    return packed


def unpack(shape: Shape, packed: Array) -> Array:
    """The inverse of `pack`, as a new array."""
    return np.concatenate([W.ravel() for W in _matrices(shape, packed)])


def _matrices(shape: Shape, packed: Array) -> list[Array]:
    """Views of a packed vector as the layers' matrices (n_out, n_in + bias), without padding."""
    views = []
    for layer in _layers(shape):
        rows = packed[layer.start : layer.end].reshape(-1, layer.stride)
        inputs = layer.n_in + shape.bias
        views.append(rows[:, :inputs] if layer.by_output else rows[:, : layer.n_out].T)
    return views


@inner
def output_at(net: Net) -> int:
    """Where the network's output stands in `acts`, and ∂loss/∂f̂ in `deltas`."""
    return int(net.layers[-1, OUT])


@inner
def prediction(net: Net) -> Array:
    """The f̂ (n_out,) of the last `forward`: a view of the last activations."""
    out = output_at(net)
    return net.acts[out : out + net.layers[-1, N_OUT]]


@compiled
def forward(net: Net, x: Array) -> None:
    """f̂(x) for x (n_in,), to be had as `prediction(net)`."""
    copy(x, net.acts)
    propagate(net)


@compiled
def propagate(net: Net) -> None:
    """`forward` once more, with the x it had."""
    acts, n_layers, finite = net.acts, len(net.layers), True
    real = acts.dtype.type
    for layer in range(n_layers):
        n_in, n_out, by_output, stride, start, end, at, out = net.layers[layer]
        acts[at + n_in] = real(net.bias)
        W = net.w[start:end].reshape(-1, stride)
        if by_output:
            _multiply_rows(W, acts[at : at + stride], acts[out : out + n_out])
        else:
            _add_rows(W, acts[at : at + n_in + net.bias], acts[out : out + stride])
        if layer < n_layers - 1:
            # A bounded activation would hide a weight that is infinite.
            finite = finite and is_finite(acts[out : out + n_out])
            _activate(acts[out : out + n_out], net.activation)
    if not finite:
        acts[output_at(net)] = math.nan


@compiled
def _multiply_rows(W: Array, a: Array, z: Array) -> None:
    """z_i = Σ_j W_ij a_j."""
    for i in range(z.size):
        total = W.dtype.type(0.0)
        for j in range(a.size):
            total += W[i, j] * a[j]
        z[i] = total


@compiled
def _add_rows(W: Array, a: Array, z: Array) -> None:
    """z_i = Σ_j W_ji a_j."""
    for i in range(z.size):
        z[i] = W.dtype.type(0.0)
    whole = a.size // 4 * 4
    for j in range(0, whole, 4):  # four at once spare three fourths of z's traffic
        a0, a1, a2, a3 = a[j : j + 4]
        for i in range(z.size):
            z[i] += a0 * W[j, i] + a1 * W[j + 1, i] + a2 * W[j + 2, i] + a3 * W[j + 3, i]
    for j in range(whole, a.size):
        for i in range(z.size):
            z[i] += a[j] * W[j, i]


@compiled
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
    """Update a row of weights from its gradient a·delta, and return Σ w delta from before it.

    That is the error passed back to one input, if the row is an input's and delta the errors.

    Args:
        a: times √(1 − β), so that a·delta is √(1 − β) g.
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
    """Back-propagate and update every weight once, in place, by the network's rule.

    The activations are those of the last `forward`; the output's deltas hold ∂loss/∂f̂. Where that
    `forward` was not finite nothing is learned: the weights stay as they ended the run.
    """
    if not is_finite(prediction(net)):
        return
    net.updates[0] += 1
    if net.rule == MADAM:
        _learn_by_madam(net)
    else:
        gradient(net, net.g)
        descend(net.rule, net.settings, net.updates[0], net.w, net.g, net.m, net.v)


@compiled
def _learn_by_madam(net: Net) -> None:
    """Alg. 1, in one pass."""
    real = net.w.dtype.type
    eta, eta_max, sigma_max, beta = net.settings
    correction = 1.0 - beta ** net.updates[0] if net.bias_correction else 1.0
    small = math.sqrt((1.0 - beta) / correction)
    fresh, forget, limit = real(math.sqrt(1.0 - beta)), real(beta), real(sigma_max)
    rate, most = real(eta / small), real(eta_max / eta * small)
    for layer in range(len(net.layers) - 1, -1, -1):
        n_in, n_out, by_output, stride, start, end, at, out = net.layers[layer]
        delta, back = net.deltas[out : out + stride], net.deltas[at : at + n_in]
        if by_output:
            _pass_back(
                net.w[start:end].reshape(-1, stride),
                net.deltas[out : out + n_out],
                back,
            )
            for i in range(n_out):
                row, a = start + i * stride, net.acts[at : at + stride]
                w, v = net.w[row : row + stride], net.v[row : row + stride]
                _madam_row(w, v, a, delta[i] * fresh, forget, rate, most, limit)
        else:
            for j in range(n_in + net.bias):
                row, a = start + j * stride, net.acts[at + j] * fresh
                w, v = net.w[row : row + stride], net.v[row : row + stride]
                error = _madam_row(w, v, delta, a, forget, rate, most, limit)
                if j < n_in:
                    back[j] = error
        _times_slope(back, net.acts[at : at + n_in], net.activation)


@compiled
def gradient(net: Net, g: Array) -> None:
    """∂loss/∂w into `g`, in the kernel's order and without any update; otherwise as `learn`."""
    for layer in range(len(net.layers) - 1, -1, -1):
        n_in, n_out, by_output, stride, start, end, at, out = net.layers[layer]
        W, G = net.w[start:end].reshape(-1, stride), g[start:end].reshape(-1, stride)
        back = net.deltas[at : at + n_in]
        if by_output:
            delta = net.deltas[out : out + n_out]
            _pass_back(W, delta, back)
            _outer(delta, net.acts[at : at + stride], G)
        else:
            delta = net.deltas[out : out + stride]
            _multiply_rows(W, delta, back)
            _outer(net.acts[at : at + n_in + net.bias], delta, G)
        _times_slope(back, net.acts[at : at + n_in], net.activation)


@compiled
def _outer(a: Array, b: Array, out: Array) -> None:
    """out_ij = a_i b_j."""
    for i in range(a.size):
        for j in range(b.size):
            out[i, j] = a[i] * b[j]


@compiled
def _pass_back(W: Array, delta: Array, back: Array) -> None:
    """back_j = Σ_i W_ij δ_i."""
    for j in range(back.size):
        back[j] = W.dtype.type(0.0)
    for i in range(delta.size):
        for j in range(back.size):
            back[j] += W[i, j] * delta[i]


@compiled
def _times_slope(delta: Array, a: Array, activation: int) -> None:
    """δ ← δ σ'(z), with σ'(z) from a = σ(z)."""
    one, zero = delta.dtype.type(1.0), delta.dtype.type(0.0)
    if activation == 0:
        for i in range(delta.size):
            delta[i] *= a[i] * (one - a[i])
    elif activation == 1:
        for i in range(delta.size):
            delta[i] *= one - a[i] * a[i]
    else:
        for i in range(delta.size):
            delta[i] *= one if a[i] > zero else zero
