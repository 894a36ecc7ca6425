"""SGD, Adam and sign-SGD: the kernel against torch, and the rules against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from dnnmso_mj.controllers.dnn_mso import DnnMsoController
from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.learner import KernelLearner, Learner, build_learner
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.network import Shape
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import Adam, Madam, Network, Rule, Sgd, SignSgd
from dnnmso_mj.simulation import Simulation
from dnnmso_mj.torch_learner import TorchLearner
from dnnmso_mj.trace import Trace

SGD = Sgd(kind="sgd", eta=0.003)
HEAVY = Sgd(kind="sgd", eta=0.001, momentum=0.9)
ADAM = Adam(kind="adam", eta=0.002)
SIGN = SignSgd(kind="sign_sgd", eta=1e-4)
RULES = pytest.mark.parametrize(
    "rule", [SGD, HEAVY, ADAM, SIGN], ids=["sgd", "heavy", "adam", "sign"]
)
BACKENDS = pytest.mark.parametrize("backend", ["kernel", "torch"])


def learners(rule: Rule, network: Network) -> tuple[Learner, Learner]:
    fast = build_learner(network, rule, 4, 4, seed=5)
    slow = build_learner(network.model_copy(update={"backend": "torch"}), rule, 4, 4, seed=5)
    assert isinstance(fast, KernelLearner)
    assert isinstance(slow, TorchLearner)
    return fast, slow


@RULES
@pytest.mark.parametrize("activation", ["sigmoid", "tanh", "relu"])
@pytest.mark.parametrize("hidden", [(16,), (12, 20, 7), (16,) * 8], ids=["1", "3", "8"])
def test_kernel_learns_as_torch_over_two_hundred_updates(rule, activation, hidden):
    network = Network(hidden=hidden, activation=activation, precision="float64")
    fast, slow = learners(rule, network)
    rng = np.random.default_rng(6)
    before = fast.state()["weights"]
    for _ in range(200):
        x = rng.normal(size=4)
        target = np.tanh(x)
        fast.learn(fast.predict(x) - target)
        slow.learn(slow.predict(x) - target)
        for name in ("weight_norm", "update_ratio", "eta_bound", "gradient_change", "drt_bound"):
            mine, theirs = getattr(fast.monitors, name), getattr(slow.monitors, name)
            assert np.allclose(mine, theirs, rtol=1e-7, atol=1e-10), name
        assert fast.monitors.clipped == slow.monitors.clipped == 0.0
    weights = fast.state()["weights"]
    assert np.allclose(weights, slow.state()["weights"], rtol=1e-10, atol=1e-10)
    assert not np.array_equal(weights, before)


@RULES
@BACKENDS
def test_a_restored_learner_goes_on_bit_for_bit(rule, backend):
    network = Network(hidden=(8, 8), backend=backend)
    samples = np.random.default_rng(0).normal(size=(40, 4))
    one = build_learner(network, rule, 4, 4, seed=1)
    for x in samples[:17]:
        one.learn(one.predict(x) - x)
    other = build_learner(network, rule, 4, 4, seed=99)
    other.restore(one.state())
    for x in samples[17:]:
        one.learn(one.predict(x) - x)
        other.learn(other.predict(x) - x)
    for name, value in one.state().items():
        assert np.array_equal(value, other.state()[name]), name


def weights_after(
    rule: Rule, w: np.ndarray, gradients: list[list[float]], backend: str
) -> np.ndarray:
    """A linear 1-4 "network" whose gradient is the given one."""
    shape = Shape((1, 4), bias=False, activation="sigmoid")
    kind = KernelLearner if backend == "kernel" else TorchLearner
    learner = kind(shape, w.copy(), rule)
    for g in gradients:
        learner.predict(np.ones(1))
        learner.learn(np.array(g))
    return learner.state()["weights"]


W = np.array([1.0, -2.0, 0.0, 4.0])
G = [1e-3, -5.0, 7.0, 0.0]


@BACKENDS
def test_sgd_steps_by_the_gradient_and_momentum_adds_what_went_before(backend):
    g, h = np.array(G), np.array([1.0, 2.0, -3.0, 1.0])
    assert np.allclose(weights_after(SGD, W, [G], backend), W - 0.003 * g, rtol=1e-14)
    after = weights_after(HEAVY, W, [G, h.tolist()], backend)
    assert np.allclose(after, W - 0.001 * (g + (0.9 * g + h)), rtol=1e-14)


@BACKENDS
def test_the_first_step_of_adam_is_eta_whatever_the_gradients_size(backend):
    expected = W - 0.002 * np.sign(G) / (1 + 1e-8 / np.maximum(np.abs(G), 1e-300))
    expected[3] = W[3]
    assert np.allclose(weights_after(ADAM, W, [G], backend), expected, rtol=1e-13)


@BACKENDS
def test_sign_sgd_steps_by_eta_and_a_weight_without_gradient_stays(backend):
    after = weights_after(SIGN, W, [G, G], backend)
    assert np.allclose(after, W - 2e-4 * np.sign(G), rtol=1e-14)
    assert after[3] == W[3]


@RULES
def test_padding_of_the_kernel_stays_zero(rule):
    learner = build_learner(Network(hidden=(5, 20)), rule, 3, 2, seed=0)
    padding = learner.net.w == 0
    for x in np.random.default_rng(1).normal(size=(5, 3)):
        learner.learn(learner.predict(x) - 1.0)
    assert padding.any()
    for values in (learner.net.w, learner.net.m, learner.net.v):
        assert not np.any(values[padding])


# In the closed loop.

ETA = {"sgd": 0.01, "adam": 3e-3, "sign_sgd": 1e-3}


def run(*overrides: str) -> tuple[Trace, Simulation]:
    scenario = load_scenario("paper", ["duration=2.0", *overrides])
    simulation = Simulation(scenario, Mjcf.read(find_model(scenario.plant.model)))
    recorder = MemoryRecorder(simulation.layout, scenario.n_ticks)
    return recorder.trace(scenario, simulation.run(recorder)), simulation


def rule_of(kind: str) -> list[str]:
    return [f"controller.optimizer.kind={kind}", f"controller.optimizer.eta={ETA[kind]}"]


@pytest.mark.parametrize("kind", list(ETA))
def test_each_rule_tracks_better_than_no_network(kind):
    trace, simulation = run(*rule_of(kind))
    alone, _ = run("controller.kind=no_network")
    assert isinstance(simulation.controller, DnnMsoController)
    assert not np.any(trace["clipped"])
    learned, unlearned = (compute_metrics(t)["rmse_steady"] for t in (trace, alone))
    assert learned < 0.2 * unlearned


def test_the_default_rule_is_madam_with_its_own_key():
    spec = load_scenario("paper", ["controller.madam.eta=2e-3"]).controller
    assert spec.rule == Madam(eta=2e-3)
    chosen = load_scenario("paper", rule_of("adam")).controller
    assert chosen.rule == Adam(kind="adam", eta=3e-3)


@pytest.mark.parametrize(
    ("override", "text"),
    [
        (["controller.optimizer.kind=lion"], "adam"),
        (["controller.optimizer.kind=sgd", "controller.optimizer.eta=0"], "a number > 0"),
        (["controller.optimizer.kind=sgd", "controller.optimizer.beta1=0.5"], "momentum"),
        (["controller.optimizer.eta=0.5"], "unknown key; allowed: kind"),
        (["controller.optimizer.kind=adam", "controller.optimizer.beta2=0.99999999"], "float32"),
    ],
)
def test_what_a_rule_does_not_have_or_cannot_do_is_refused(override, text):
    with pytest.raises(ScenarioError, match=text):
        load_scenario("paper", override)
