"""The kernel on every path it has: both ways to store a layer, both precisions, short and long
exponents. Autograd gives the gradients, NumPy the updates as they are printed."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

from dnnmso_mj import kernel
from dnnmso_mj.kernel import Net, build_net, pack, unpack
from dnnmso_mj.network import Shape, TorchNetwork
from dnnmso_mj.scenario import Adam, Madam, Rule, Sgd, SignSgd
from tests.kernel_loss import last_output, output

# Layers of 40 inputs and 3 outputs are stored by output, of 3 and 20 by input, of 16 and 16 alike.
SIZES = (40, 3, 20, 16, 16, 2)
SHAPES = [Shape(SIZES, bias, act) for bias, act in ((True, "sigmoid"), (False, "tanh"))]
SHAPES += [Shape((5, 33, 2), True, "relu"), Shape((1, 1), False, "relu")]
NAMES = ["deep", "without bias", "wide relu", "one weight"]
EPS = {"float64": 1e-13, "float32": 2e-6}

EACH_SHAPE = pytest.mark.parametrize("shape", SHAPES, ids=NAMES)
EACH_PRECISION = pytest.mark.parametrize("precision", EPS)


def sample(shape: Shape, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights, some zero, and an input and an error that vary in size."""
    rng = np.random.default_rng(seed)
    w = 0.3 * rng.normal(size=shape.n_weights)  # no neuron is saturated
    w[3::17] = 0.0
    return w, rng.normal(size=shape.sizes[0]), rng.normal(size=shape.sizes[-1])


def autograd(shape: Shape, w: np.ndarray, x: np.ndarray, delta: np.ndarray) -> np.ndarray:
    """∂(δᵀf̂)/∂w in double precision."""
    net = TorchNetwork(shape, w.astype(float))
    net(torch.tensor(x)).backward(torch.tensor(delta))
    return net.flat_gradient()


def learn(net: Net, x: np.ndarray, delta: np.ndarray) -> None:
    kernel.forward(net, x)
    last = kernel.output_at(net)
    net.deltas[last : last + delta.size] = delta
    kernel.learn(net)


def printed_madam(
    w: np.ndarray, v: np.ndarray, g: np.ndarray, k: int, spec: Madam
) -> tuple[np.ndarray, np.ndarray]:
    """Alg. 1 as it is printed: W and ḡ² after update k."""
    v = (1 - spec.beta) * g**2 + spec.beta * v
    g_bar = np.sqrt(v / (1 - spec.beta**k) if spec.bias_correction else v)
    ratio = np.divide(g, g_bar, out=np.zeros_like(g), where=g_bar > 0)
    most = spec.eta_max / spec.eta
    w = w * np.exp(-spec.eta * np.sign(w) * np.clip(ratio, -most, most))
    return np.clip(w, -spec.sigma_max, spec.sigma_max), v


@EACH_SHAPE
@EACH_PRECISION
@pytest.mark.parametrize(
    ("eta", "eta_max"), [(0.01, 0.02), (0.05, 0.1), (0.055, 0.11), (0.45, 0.9), (0.09, 0.9)]
)
def test_three_updates_are_madam_as_printed(shape, precision, eta, eta_max):
    """The first ratio, 1/√(1−β), is beyond the clamp if it is 2, as long as it is not corrected."""
    for corrected in (False, True):
        spec = Madam(eta=eta, eta_max=eta_max, sigma_max=0.5, beta=0.9, bias_correction=corrected)
        w, _, _ = sample(shape)
        w = w.astype(precision)
        net, v = build_net(shape, w, spec), np.zeros_like(w, float)
        for k in (1, 2, 3):
            _, x, delta = sample(shape, seed=k)
            x, delta = (values.astype(precision).astype(float) for values in (x, delta))
            w, v = printed_madam(w.astype(float), v, autograd(shape, w, x, delta), k, spec)
            learn(net, x, delta)
            np.testing.assert_allclose(unpack(shape, net.w), w, rtol=4 * EPS[precision] * k)
            w = unpack(shape, net.w)
        np.testing.assert_allclose(
            unpack(shape, net.v), v, rtol=3e3 * EPS[precision], atol=1e2 * EPS[precision]
        )
        assert net.updates.tolist() == [3]
        assert np.abs(w).max() <= np.array(0.5, precision)


@EACH_SHAPE
@EACH_PRECISION
def test_output_and_gradient_are_autograds_and_change_nothing(shape, precision):
    w, x, delta = sample(shape)
    w, x, delta = (values.astype(precision) for values in (w, x, delta))
    net = build_net(shape, w, Madam())
    expected = TorchNetwork(shape, w.astype(float))(torch.tensor(x.astype(float)))
    f_hat = output(net, x)
    eps = EPS[precision]
    np.testing.assert_allclose(f_hat, expected.detach().numpy(), rtol=50 * eps, atol=20 * eps)
    net.deltas[kernel.output_at(net) :][: delta.size] = delta
    g = np.full_like(net.w, 9.0)
    kernel.gradient(net, g)
    exact = autograd(shape, w, x.astype(float), delta.astype(float))
    np.testing.assert_allclose(unpack(shape, g), exact, rtol=1e3 * eps, atol=50 * eps)
    assert np.array_equal(unpack(shape, net.w), w)
    assert not net.updates.any()
    kernel.propagate(net)
    assert np.array_equal(last_output(net), f_hat)


@EACH_SHAPE
def test_each_layer_takes_the_room_of_the_better_way_to_store_it(shape):
    net, lanes = build_net(shape, sample(shape)[0], Madam()), kernel.LANES
    assert lanes * net.w.itemsize % 64 == 0  # whole 512-bit registers
    room, at = 0, 0
    for (n_in, n_out), row in zip(pairwise(shape.sizes), net.layers, strict=True):
        layer = kernel.Layer(*row.tolist())
        whole = lambda size: -(-size // lanes) * lanes  # noqa: E731
        inputs = n_in + shape.bias
        assert (layer.n_in, layer.n_out, layer.start, layer.at) == (n_in, n_out, room, at)
        assert layer.stride == whole(inputs if layer.by_output else n_out)
        room += min(inputs * whole(n_out), n_out * whole(inputs))
        assert layer.end == room
        at = layer.out
        assert at >= layer.at + inputs  # the constant input is behind the others
    assert net.w.size == net.v.size == room
    assert net.acts.size == net.deltas.size >= at + whole(shape.sizes[-1])


@EACH_SHAPE
@EACH_PRECISION
@pytest.mark.parametrize(
    "rule",
    [Madam(), Sgd(kind="sgd", eta=0.1, momentum=0.5), Adam(kind="adam", eta=0.1)],
    ids=["madam", "sgd", "adam"],
)
def test_weights_come_back_as_they_were_given_in_their_precision(shape, precision, rule):
    w = sample(shape)[0].astype(precision)
    net = build_net(shape, w, rule)
    for array in (net.w, net.v, net.m, net.g, net.acts, net.deltas):
        assert array.dtype == w.dtype
    assert (net.updates.dtype, net.layers.dtype, net.settings.dtype) == (int, int, float)
    assert net.m.size == net.g.size == (0 if isinstance(rule, Madam) else net.w.size)
    assert np.array_equal(unpack(shape, net.w), w)
    assert pack(shape, w).dtype == w.dtype
    assert np.count_nonzero(net.w) == np.count_nonzero(w)
    unpack(shape, net.w)[:] = 0.0
    assert np.array_equal(unpack(shape, net.w), w)


def printed(rule: Rule, gradients: list[np.ndarray], w: np.ndarray) -> np.ndarray:
    """The additive rules as they are printed."""
    m = v = np.zeros_like(w)
    for k, g in enumerate(gradients, 1):
        match rule:
            case Sgd():
                m = rule.momentum * m + g
                w = w - rule.eta * m
            case Adam():
                m = rule.beta1 * m + (1 - rule.beta1) * g
                v = rule.beta2 * v + (1 - rule.beta2) * g**2
                corrected = m / (1 - rule.beta1**k), np.sqrt(v / (1 - rule.beta2**k))
                w = w - rule.eta * corrected[0] / (corrected[1] + rule.eps)
            case _:
                w = w - rule.eta * np.sign(g)
    return w


@EACH_PRECISION
@pytest.mark.parametrize(
    "rule",
    [
        Sgd(kind="sgd", eta=0.1, momentum=0.7),
        Adam(kind="adam", eta=0.1, beta1=0.8, beta2=0.95, eps=0.01),
        SignSgd(kind="sign_sgd", eta=0.01),
    ],
    ids=["sgd", "adam", "sign"],
)
def test_three_updates_are_those_of_the_rule_as_printed(rule, precision):
    """A net of one layer without bias: its gradient is δ xᵀ, whatever its weights."""
    shape = Shape((3, 20), bias=False, activation="tanh")
    w = sample(shape)[0].astype(precision)
    net, gradients = build_net(shape, w, rule), []
    for seed in (1, 2, 3):
        _, x, delta = sample(shape, seed)
        x[1] = 0.0
        x, delta = x.astype(precision), delta.astype(precision)
        learn(net, x, delta)
        gradients.append(np.outer(delta, x).ravel().astype(float))
    expected = printed(rule, gradients, w.astype(float))
    eps = EPS[precision]
    np.testing.assert_allclose(unpack(shape, net.w), expected, rtol=20 * eps, atol=10 * eps)
    still = w.reshape(20, 3)[:, 1]
    assert np.array_equal(unpack(shape, net.w).reshape(20, 3)[:, 1], still)


@EACH_SHAPE
@pytest.mark.parametrize("bad", [np.inf, -np.inf, np.nan])
def test_a_weight_that_is_not_finite_shows_in_the_output_whatever_its_layer(shape, bad):
    """A bounded activation would make a number of it again."""
    w, x, _ = sample(shape)
    w, x = np.abs(w) + 0.1, np.abs(x) + 0.1  # no neuron of a ReLU is off, no product 0 · ∞
    assert np.isfinite(output(build_net(shape, w, Madam()), x)).all()
    starts = np.cumsum([0, *(W.size for W in shape.split(w))])[:-1]
    for start in starts:
        broken = w.copy()
        broken[start] = bad
        net = build_net(shape, broken, Madam())
        assert not np.isfinite(output(net, x)[0]), start


@EACH_SHAPE
@pytest.mark.parametrize("rule", [Madam(), Sgd(kind="sgd", eta=0.1)], ids=["madam", "sgd"])
def test_nothing_is_learned_from_an_output_that_is_not_finite(shape, rule):
    w, x, delta = sample(shape)
    w[-1] = np.nan  # of the last output alone
    net = build_net(shape, w, rule)
    learn(net, x, delta)
    assert np.array_equal(unpack(shape, net.w), w, equal_nan=True)
    assert net.updates.tolist() == [0]
    assert not net.v.any()
