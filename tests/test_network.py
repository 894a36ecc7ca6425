"""Network, kernel and Madam: the compiled passes against autograd, and Madam's invariants."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dnnmso_mj import kernel
from dnnmso_mj.errors import NonFiniteError
from dnnmso_mj.learner import KernelLearner, build_learner
from dnnmso_mj.madam import Madam
from dnnmso_mj.network import Shape, TorchNetwork, initial_weights, network_shape
from dnnmso_mj.scenario import Madam as MadamSpec
from dnnmso_mj.scenario import Network
from dnnmso_mj.torch_learner import TorchLearner
from tests.kernel_loss import loss_and_gradient, output

ACTIVATIONS = ("sigmoid", "tanh", "relu")
shapes = st.builds(
    Shape,
    sizes=st.lists(st.integers(1, 9), min_size=2, max_size=5).map(tuple),
    bias=st.booleans(),
    activation=st.sampled_from(ACTIVATIONS),
)


def kernel_output(shape: Shape, w: np.ndarray, x: np.ndarray) -> np.ndarray:
    return output(kernel.build_net(shape, w, MadamSpec()), x)


@given(shapes, st.integers(0, 2**32 - 1))
@settings(deadline=None)
def test_kernel_output_and_every_gradient_equal_autograd(shape, seed):
    rng = np.random.default_rng(seed)
    w, x = rng.normal(size=shape.n_weights), rng.normal(size=shape.sizes[0])
    delta = rng.normal(size=shape.sizes[-1])
    net = TorchNetwork(shape, w)
    y = net(torch.tensor(x))
    y.backward(torch.tensor(delta))
    scale = 1 + np.abs(net.flat_gradient()).max()
    assert np.allclose(kernel_output(shape, w, x), y.detach().numpy(), rtol=1e-12, atol=1e-12)
    _, gradient = loss_and_gradient(shape, w, x, delta)
    assert np.allclose(gradient, net.flat_gradient(), rtol=1e-10, atol=1e-12 * scale)


def test_gradient_equals_finite_differences():
    shape = Shape((4, 7, 5, 3), bias=True, activation="sigmoid")
    rng = np.random.default_rng(3)
    w, x, delta = rng.normal(size=shape.n_weights), rng.normal(size=4), rng.normal(size=3)
    (_, gradient), h = loss_and_gradient(shape, w, x, delta), 1e-6
    for k in rng.choice(shape.n_weights, 30, replace=False):
        step = np.zeros_like(w)
        step[k] = h
        up, down = kernel_output(shape, w + step, x), kernel_output(shape, w - step, x)
        assert gradient[k] == pytest.approx(delta @ (up - down) / (2 * h), abs=1e-7)


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("correction", [False, True])
@pytest.mark.parametrize("bias", [False, True])
def test_kernel_learns_as_the_reference_over_a_thousand_updates(activation, correction, bias):
    spec = Network(hidden=(16, 16, 16), activation=activation, bias=bias, precision="float64")
    madam = MadamSpec(bias_correction=correction)
    fast = build_learner(spec, madam, 4, 4, seed=5)
    slow = build_learner(spec.model_copy(update={"backend": "torch"}), madam, 4, 4, seed=5)
    assert isinstance(fast, KernelLearner)
    assert isinstance(slow, TorchLearner)
    rng = np.random.default_rng(6)
    for _ in range(1000):
        x, target = rng.normal(size=4), rng.normal(size=4)
        a, b = fast.predict(x).copy(), slow.predict(x)
        assert np.allclose(a, b, rtol=1e-10, atol=1e-10)
        fast.learn(a - target)
        slow.learn(b - target)
        for name in ("weight_norm", "update_ratio", "eta_bound", "gradient_change"):
            mine, theirs = getattr(fast.monitors, name), getattr(slow.monitors, name)
            assert np.allclose(mine, theirs, rtol=1e-7, atol=1e-9), name
        assert fast.monitors.drt_bound[0] == pytest.approx(slow.monitors.drt_bound[0], rel=1e-8)
        assert fast.monitors.clipped == slow.monitors.clipped
    assert np.allclose(fast.state()["weights"], slow.state()["weights"], rtol=1e-10)


def test_single_precision_learns_as_double_to_single_precision():
    """Beyond some hundred updates rounding has grown into another, equally good, trajectory."""
    spec = Network(hidden=(16, 16, 16), precision="float64")
    double = build_learner(spec, MadamSpec(), 4, 4, seed=5)
    single = build_learner(spec.model_copy(update={"precision": "float32"}), MadamSpec(), 4, 4, 5)
    assert single.state()["weights"].dtype == np.float32
    rng = np.random.default_rng(6)
    for _ in range(100):
        x, target = rng.normal(size=4), rng.normal(size=4)
        a, b = double.predict(x), single.predict(x)
        assert np.allclose(a, b, rtol=1e-4, atol=1e-4)
        assert not np.array_equal(a, b)
        double.learn(a - target)
        single.learn(b - target)


@pytest.mark.parametrize("backend", ["kernel", "torch"])
def test_a_restored_learner_goes_on_bit_for_bit(backend):
    spec, madam = Network(hidden=(8, 8), backend=backend), MadamSpec(bias_correction=True)
    rng = np.random.default_rng(0)
    samples = rng.normal(size=(40, 4))
    one = build_learner(spec, madam, 4, 4, seed=1)
    for x in samples[:17]:
        one.learn(one.predict(x) - x)
    other = build_learner(spec, madam, 4, 4, seed=99)
    other.restore(one.state())
    for x in samples[17:]:
        one.learn(one.predict(x) - x)
        other.learn(other.predict(x) - x)
    for name, value in one.state().items():
        assert np.array_equal(value, other.state()[name]), name


def test_kumar_spread_is_the_standard_deviation_by_default_and_the_variance_on_request():
    shape = network_shape(Network(hidden=(400, 400)), 4, 4)
    for spread, expected in (
        ("standard_deviation", 3.6 / 401**0.5),
        ("variance", (3.6 / 401**0.5) ** 0.5),
    ):
        spec = Network(hidden=(400, 400), init_spread=spread)
        W = shape.split(initial_weights(shape, spec, np.random.default_rng(0)))[1]
        assert W.std() == pytest.approx(expected, rel=0.01)
        assert abs(W.mean()) < 0.01 * expected
        assert np.all(W != 0)


def test_kumars_constant_of_the_sigmoid_follows_from_its_slope_at_zero():
    slope, value = 0.25, 0.5
    assert 1 / (slope * np.sqrt(1 + value**2)) == pytest.approx(3.6, abs=0.03)


def test_signals_keep_their_size_through_the_layers_with_kumars_scale():
    shape = network_shape(Network(hidden=(200,) * 6), 200, 200)
    w = initial_weights(shape, Network(hidden=(200,) * 6), np.random.default_rng(1))
    net = kernel.build_net(shape, w, MadamSpec())
    kernel.forward(net, np.random.default_rng(2).normal(size=200))
    spreads = [net.acts[start : start + 200].std() for start in net.layers[:6, kernel.OUT]]
    assert spreads[-1] / spreads[0] > 0.5


@pytest.mark.parametrize(("exponential", "order"), [("_exp_double", 8), ("_exp_single", 5)])
def test_exponential_of_the_kernel_is_off_by_no_more_than_the_next_term(exponential, order):
    x = np.linspace(-1 / 8, 1 / 8, 2001)
    ours = np.array([getattr(kernel, exponential).py_func(v, float) for v in x])
    most = np.abs(x) ** (order + 1) / math.factorial(order + 1) * np.exp(1 / 8)
    assert np.all(np.abs(ours - np.exp(-x)) <= most + 4e-16)
    assert most.max() < {8: 3e-14, 5: 8e-9}[order]


@given(shapes, st.integers(0, 2**32 - 1))
def test_kernel_order_is_padded_with_zeros_that_stay_zero(shape, seed):
    rng = np.random.default_rng(seed)
    w = rng.normal(size=shape.n_weights)
    learner = KernelLearner(shape, w, MadamSpec())
    net = learner.net
    assert np.array_equal(kernel.unpack(shape, net.w), w)
    padding = kernel.pack(shape, np.ones_like(w)) == 0
    learner.predict(rng.normal(size=shape.sizes[0]))
    learner.learn(rng.normal(size=shape.sizes[-1]))
    assert not np.any(net.w[padding])
    assert not np.any(net.v[padding])


# Madam's invariants, on the kernel and on the reference alike.

weights = st.lists(
    st.floats(-2000, 2000).filter(lambda v: v == 0 or abs(v) > 1e-100), min_size=4, max_size=4
)
# Squares of gradients under 1e-150 are nothing in double precision: no update is right for them.
gradients = st.lists(
    st.floats(-1e6, 1e6).filter(lambda v: v == 0 or abs(v) > 1e-100), min_size=4, max_size=4
)
specs = st.builds(
    MadamSpec,
    eta=st.floats(1e-5, 0.1),
    eta_max=st.floats(0.1, 1.0),
    sigma_max=st.floats(0.5, 1250),
    beta=st.floats(0, 0.9999),
    bias_correction=st.booleans(),
)


def kernel_madam(w: np.ndarray, gradients: list[list[float]], spec: MadamSpec) -> list[np.ndarray]:
    """Weights after each update: a linear 1-4 "network" whose gradient is the given one."""
    shape = Shape((1, 4), bias=False, activation="sigmoid")
    learner = KernelLearner(shape, w.copy(), spec)
    out = []
    for g in gradients:
        learner.predict(np.ones(1))
        learner.learn(np.array(g))
        out.append(learner.state()["weights"])
    return out


def torch_madam(w: np.ndarray, gradients: list[list[float]], spec: MadamSpec) -> list[np.ndarray]:
    W = torch.tensor(w, requires_grad=True)
    optimizer, out = Madam([W], spec), []
    for g in gradients:
        W.grad = torch.tensor(g, dtype=torch.float64)
        optimizer.step()
        out.append(W.detach().numpy().copy())
    return out


IMPLEMENTATIONS = pytest.mark.parametrize("madam", [kernel_madam, torch_madam])


@IMPLEMENTATIONS
@given(w=weights, g=st.lists(gradients, min_size=1, max_size=4), spec=specs)
@settings(deadline=None)
def test_madam_keeps_signs_bounds_each_update_and_each_weight(madam, w, g, spec):
    before = np.array(w)
    if not before.any():
        before[0] = 1.0
    for after in madam(before, g, spec):
        assert np.array_equal(np.sign(after), np.sign(before))
        assert np.all(np.abs(after) <= spec.sigma_max)
        inside = np.abs(before) <= spec.sigma_max * np.exp(-spec.eta_max)
        growth = np.abs(after[inside] - before[inside])
        most = (np.exp(spec.eta_max) - 1) * (1 + 1e-12)
        assert np.all(growth <= most * np.abs(before[inside]))
        before = after


@IMPLEMENTATIONS
@given(w=weights, spec=specs)
@settings(deadline=None)
def test_madam_moves_every_weight_against_its_gradient(madam, w, spec):
    before = np.clip(np.array(w), -0.4 * spec.sigma_max, 0.4 * spec.sigma_max)
    before[before == 0] = 0.1
    g = np.array([1.0, -2.0, 3.0, -4.0])
    after = madam(before, [g.tolist()], spec)[0]
    assert np.all((after - before) * g < 0)


@IMPLEMENTATIONS
def test_madam_leaves_weights_without_gradient_alone(madam):
    w = np.array([1.0, -1.0, 0.5, 2.0])
    after = madam(w, [[0.0, 0.0, 0.0, 0.0]], MadamSpec())[0]
    assert np.array_equal(after, w)


@IMPLEMENTATIONS
def test_first_update_as_printed_is_one_over_root_of_one_minus_beta_times_bold(madam):
    w, g = np.array([1.0, 2.0, -3.0, 4.0]), [1e-3, -5.0, 7.0, -1e5]
    printed = madam(w, [g], MadamSpec())[0]
    corrected = madam(w, [g], MadamSpec(bias_correction=True))[0]
    step = np.abs(np.log(printed / w)), np.abs(np.log(corrected / w))
    assert np.allclose(step[0], 0.001 / np.sqrt(1 - 0.999), rtol=1e-9)
    assert np.allclose(step[1], 0.001, rtol=1e-9)


@IMPLEMENTATIONS
def test_second_moment_is_the_printed_average(madam):
    """Two updates by hand: ḡ² = (1−β)g₁² then (1−β)g₂² + β(1−β)g₁²."""
    w, beta, eta = np.array([1.0, 1.0, 1.0, 1.0]), 0.9, 0.01
    spec = MadamSpec(eta=eta, eta_max=1.0, beta=beta)
    after = madam(w, [[2.0] * 4, [-1.0] * 4], spec)[-1]
    first = 2 / np.sqrt(0.1 * 4)
    second = -1 / np.sqrt(0.1 * 1 + 0.9 * 0.1 * 4)
    assert np.allclose(after, np.exp(-eta * first) * np.exp(-eta * second), rtol=1e-12)


@IMPLEMENTATIONS
def test_a_gradient_that_is_not_finite_stops_and_is_named(madam):
    for bad in (np.nan, np.inf, -np.inf):
        with pytest.raises(NonFiniteError, match="gradient"):
            madam(np.ones(4), [[1.0, bad, 1.0, 1.0]], MadamSpec())


# The reference as torch expects an optimiser to be.


def test_reference_evaluates_a_closure_with_gradients_and_returns_its_loss():
    W = torch.tensor([1.0, -2.0], dtype=torch.float64, requires_grad=True)
    optimizer = Madam([W], MadamSpec())

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        loss = (W**2).sum()
        loss.backward()
        return loss

    assert float(optimizer.step(closure)) == 5.0
    assert float(optimizer.step(closure)) < 5.0
    assert optimizer.step() is None


def test_reference_keeps_each_parameters_moments_apart_and_skips_those_without_gradient():
    one, other, still = (torch.ones(2, dtype=torch.float64, requires_grad=True) for _ in range(3))
    spec = MadamSpec(eta=0.01, beta=0.9, bias_correction=True)
    optimizer = Madam([one, other, still], spec)
    for k, (g, h) in enumerate([(1.0, 1e-3), (-2.0, 3e-3), (0.5, -1e-3)], 1):
        one.grad, other.grad = torch.full_like(one, g), torch.full_like(other, h)
        optimizer.step()
        assert [optimizer.state[W]["k"] for W in (one, other)] == [k, k]
    for W, gradients in ((one, [1.0, -2.0, 0.5]), (other, [1e-3, 3e-3, -1e-3])):
        moment = sum(0.1 * 0.9 ** (2 - k) * g**2 for k, g in enumerate(gradients))
        assert optimizer.state[W]["g_bar_sq"].tolist() == pytest.approx([moment] * 2, rel=1e-12)
        weight = 1.0
        for k in range(1, 4):
            moment = sum(0.1 * 0.9 ** (k - 1 - j) * gradients[j] ** 2 for j in range(k))
            weight *= math.exp(-0.01 * gradients[k - 1] / math.sqrt(moment / (1 - 0.9**k)))
        assert W.tolist() == pytest.approx([weight] * 2, rel=1e-12)
    assert still.tolist() == [1.0, 1.0]
    assert still not in optimizer.state


def test_reference_clamps_ratios_of_either_sign():
    W = torch.ones(2, dtype=torch.float64, requires_grad=True)
    optimizer = Madam([W], MadamSpec(eta=0.01, eta_max=0.02, beta=0.99))
    W.grad = torch.tensor([1.0, -1.0], dtype=torch.float64)  # ratios of 10 and -10, limits of 2
    optimizer.step()
    assert W.tolist() == pytest.approx([math.exp(-0.02), math.exp(0.02)], rel=1e-12)


def test_reference_names_the_gradient_that_is_not_finite_and_changes_nothing():
    W = torch.ones(3, dtype=torch.float64, requires_grad=True)
    optimizer = Madam([W], MadamSpec())
    W.grad = torch.tensor([1.0, -torch.inf, 2.0], dtype=torch.float64)
    with pytest.raises(NonFiniteError, match=r"^gradient = -inf$"):
        optimizer.step()
    assert W.tolist() == [1.0] * 3
    assert not optimizer.state[W]
