"""Lewis's network controller and the MSO with radial basis functions: laws, and what they do."""

from __future__ import annotations

from pathlib import Path

import dm_control
import numpy as np
import pytest

from dnnmso_mj.controllers import LEARNING, MODEL_FROZEN, Inputs, build_controller
from dnnmso_mj.dynamics import TwoLink
from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.simulation import Simulation, simulate

ARM = TwoLink((1.0, 2.3), (1.0, 1.0))
DT = 0.001
KINDS = pytest.mark.parametrize("kind", ["lewis_nn", "rbf_mso"])
CLOCKED = {"compute_us", "deadline_missed", "wake_late_us"}
WRONG = {"masses": [1.0, 1.0]}  # kg, of the model that rbf_mso is given


def spec_of(kind: str, **settings):
    if kind == "rbf_mso":
        settings["inversion"] = {"effectiveness": {"kind": "inertia"} | WRONG}
    return {"kind": kind} | settings


class Edited:
    """A controller whose state may be changed after each of its updates."""

    def __init__(self, controller, edit) -> None:
        self._controller, self._edit = controller, edit
        self.n_layers = controller.n_layers

    def __getattr__(self, name):
        return getattr(self._controller, name)

    def update(self, inputs):
        before = self._controller.state()
        command = self._controller.update(inputs)
        after = self._controller.state()
        if self._edit:
            self._controller.restore(self._edit(before, after))
        return command


def run_edited(scenario, mjcf, edit):
    simulation = Simulation(scenario, mjcf)
    simulation.controller = Edited(simulation.controller, edit)
    recorder = MemoryRecorder(simulation.layout, scenario.n_ticks)
    return recorder.trace(scenario, simulation.run(recorder))


def rmse(trace) -> float:
    """Of a run that diverged: infinite."""
    metrics = compute_metrics(trace)
    return np.inf if metrics["diverged"] else metrics["rmse_steady"]


def fed(n_ticks: int, n: int = 2):
    """Inputs of smooth motion near a reference, without a plant."""
    inputs = Inputs.zeros(n)
    phase = np.random.default_rng(3).uniform(0, 6, size=(3, 2 * n))
    for t in np.arange(n_ticks) * DT:
        inputs.x_ref[:] = np.sin(3 * t + phase[0])
        inputs.xd_ref[:] = 3 * np.cos(3 * t + phase[0])
        inputs.x[:] = inputs.x_ref + 0.3 * np.sin(17 * t + phase[1])
        yield inputs


def test_lewis_is_the_published_law(make_scenario, two_link):
    spec = spec_of("lewis_nn", hidden=7, K_v=[20.0, 9.0], F=80.0, G=15.0, kappa=0.05)
    controller = build_controller(make_scenario(spec), two_link)
    V, W = (controller.state()[name] for name in "VW")
    assert not W.any()
    for inputs in fed(500):
        e, ed = np.split(inputs.x_ref - inputs.x, 2)
        y = np.concatenate([e, ed, inputs.x_ref, inputs.xd_ref[2:], [1.0]])
        r, z = ed + 5.0 * e, V.T @ y
        s = np.append(1 / (1 + np.exp(-z)), 1.0)
        slope = np.vstack([np.diag(s[:-1] * (1 - s[:-1])), np.zeros(7)])  # σ̂' (8, 7)
        norm = np.sqrt((V**2).sum() + (W**2).sum())
        expected = W.T @ s + np.array([20.0, 9.0]) * r + 0.05 * (norm + 100.0) * r
        tau = controller.update(inputs).tau
        assert np.allclose(tau, expected, rtol=1e-10, atol=1e-10)
        size = np.linalg.norm(r)
        dW = 80.0 * (np.outer(s, r) - np.outer(slope @ z, r) - 0.05 * size * W)
        dV = 15.0 * (np.outer(y, slope.T @ W @ r) - 0.05 * size * V)
        W, V = W + DT * dW, V + DT * dV
    assert np.abs(W).max() > 0.5
    assert np.allclose(controller.state()["W"], W, rtol=1e-9)
    assert np.allclose(controller.state()["V"], V, rtol=1e-9)


def test_rbf_mso_is_eq_4_with_a_gradient_law(make_scenario, two_link):
    spec = spec_of("rbf_mso", centres=9, Gamma=200.0, kappa=0.02, box=[1.0, 1.5, 2.0, 2.5])
    controller = build_controller(make_scenario(spec), two_link)
    believed, box = TwoLink((1.0, 1.0), (1.0, 1.0)), np.array([1.0, 1.5, 2.0, 2.5])
    c, W = controller.state()["centres"], np.zeros((9, 2))
    assert np.all(np.abs(c) <= box)
    x_hat = np.zeros(4)
    for k, inputs in enumerate(fed(500)):
        if k == 0:
            x_hat = inputs.x.copy()
            controller.reset(x_hat)
        x, e_a = inputs.x, inputs.x - x_hat
        B = np.linalg.inv(believed.inertia(x[:2]))
        phi = np.exp(-0.5 * (((x - c) / (0.7 * box)) ** 2).sum(axis=1))
        learned = B @ (W.T @ phi)
        f = np.append(x[2:], believed.acceleration(x[:2], x[2:], np.zeros(2)))
        f_hat = np.append(x_hat[2:], believed.acceleration(x_hat[:2], x_hat[2:], np.zeros(2)))
        wanted = inputs.xd_ref - f - 7.5 * (x - inputs.x_ref)
        Bu = wanted[2:] - learned + 7.5 * wanted[:2]
        tau = controller.update(inputs).tau
        assert np.allclose(tau, np.linalg.solve(B, Bu), rtol=1e-9, atol=1e-9)
        x_hat = x_hat + DT * (f_hat + np.append([0, 0], learned + Bu) + 30.0 * e_a)
        W = W + DT * 200.0 * (np.outer(phi, B @ e_a[2:]) - 0.02 * np.linalg.norm(e_a) * W)
        inputs.tau[:] = tau
    assert np.abs(W).max() > 0.1
    assert np.allclose(controller.state()["W"], W, rtol=1e-8)


@pytest.mark.parametrize("size", [1e-3, 1.0, 30.0])
def test_forgetting_bounds_lewis_weights_however_long_the_error_lasts(
    make_scenario, two_link, size
):
    """‖Ŵ'‖ ≤ F‖r‖(sup‖σ̂ − σ̂'z‖ − κ‖Ŵ‖), and |σ(z) − z σ'(z)| < 1.11 for any z."""
    kappa, hidden = 0.05, 10
    bound = 1.11 * np.sqrt(hidden + 1) / kappa
    norms = {}
    for used in (kappa, 0.0):
        spec = spec_of("lewis_nn", kappa=used, F=1000.0 / size, G=10.0 / size, hidden=hidden)
        controller = build_controller(make_scenario(spec), two_link)
        inputs = Inputs.zeros(2)
        inputs.x_ref[:] = size
        for _ in range(2000):
            controller.update(inputs)
        norms[used] = np.linalg.norm(controller.state()["W"])
    assert 0.2 * bound < norms[kappa] <= bound
    assert norms[0.0] > 2 * bound


@KINDS
def test_learning_helps_and_its_sign_matters(make_scenario, two_link, kind):
    scenario = make_scenario(spec_of(kind), duration=2.0)

    def unlearn(before, after):
        return after | {name: before[name] for name in ("V", "W") if name in after}

    def turn_round(before, after):
        turned = {name: 2 * before[name] - after[name] for name in ("V", "W") if name in after}
        return after | turned

    learning, still, wrong = (
        rmse(run_edited(scenario, two_link, edit)) for edit in (None, unlearn, turn_round)
    )
    assert learning < 0.5 * still
    assert wrong > 1.2 * still


@KINDS
def test_interpreted_and_compiled_loop_give_the_same_run(make_scenario, two_link, kind):
    scenario = make_scenario(spec_of(kind), duration=1.0, imperfections={"torque_limit": 60.0})
    interpreted, compiled = run_edited(scenario, two_link, None), simulate(scenario, two_link)
    for name in set(compiled) - CLOCKED:
        assert np.array_equal(interpreted[name], compiled[name]), name


@KINDS
def test_a_restored_controller_goes_on_bit_for_bit(make_scenario, two_link, kind):
    one, other = (
        build_controller(make_scenario(spec_of(kind), seed=seed), two_link) for seed in (1, 2)
    )
    first = next(fed(1))
    one.reset(first.x)
    for k, inputs in enumerate(fed(400)):
        if k == 200:
            other.restore(one.state())
        tau = one.update(inputs).tau.copy()
        if k >= 200:
            assert np.array_equal(other.update(inputs).tau, tau)
    for name, value in one.state().items():
        assert np.array_equal(value, other.state()[name]), name


@KINDS
def test_a_frozen_model_keeps_its_weights_and_goes_on_commanding(make_scenario, two_link, kind):
    controller = build_controller(make_scenario(spec_of(kind)), two_link)
    for k, inputs in enumerate(fed(60)):
        inputs.frozen[0] = LEARNING if k < 30 else MODEL_FROZEN
        before = controller.state()["W"]
        tau = controller.update(inputs).tau
        assert np.array_equal(controller.state()["W"], before) == (k >= 30)
        assert np.all(tau != 0.0)


def test_what_rbf_mso_predicts_is_its_model_and_what_it_learned(make_scenario, two_link):
    controller = build_controller(make_scenario(spec_of("rbf_mso", centres=5)), two_link)
    believed = TwoLink((1.0, 1.0), (1.0, 1.0))
    x = np.array([0.3, -0.8, 1.0, -0.5])
    known = believed.acceleration(x[:2], x[2:], np.zeros(2))
    assert np.allclose(controller.dynamics(x), known, rtol=1e-10)
    state = controller.state()
    state["W"][:] = np.random.default_rng(0).normal(size=(5, 2))
    controller.restore(state)
    phi = np.exp(-0.5 * (((x - state["centres"]) / (0.7 * 1.5)) ** 2).sum(axis=1))
    learned = np.linalg.solve(believed.inertia(x[:2]), state["W"].T @ phi)
    assert np.allclose(controller.dynamics(x), known + learned, rtol=1e-10)


def test_what_lewis_predicts_is_the_torque_of_its_network_on_the_path(make_scenario, two_link):
    controller = build_controller(make_scenario(spec_of("lewis_nn")), two_link)
    x = np.array([0.3, -0.8, 1.0, -0.5])
    assert not controller.dynamics(x).any()
    for inputs in fed(300):
        controller.update(inputs)
    V, W = (controller.state()[name] for name in "VW")
    y = np.concatenate([np.zeros(4), x, np.zeros(2), [1.0]])
    torque = W.T @ np.append(1 / (1 + np.exp(-V.T @ y)), 1.0)
    expected = -np.linalg.solve(ARM.inertia(x[:2]), torque)
    assert np.allclose(controller.dynamics(x), expected, rtol=1e-10)
    inputs = Inputs.zeros(2)
    inputs.x[:] = x
    assert np.allclose(controller.update(inputs).f_hat, np.append(x[2:], expected), rtol=1e-10)


@pytest.mark.parametrize(
    ("sets", "gain"),
    [
        (["controller.kind=lewis_nn"], 20),
        (["controller.kind=rbf_mso", "controller.inversion.effectiveness.masses=[1, 1]"], 20),
    ],
)
def test_on_the_papers_task_it_beats_itself_without_learning(sets, gain):
    freeze = "events=[{kind: freeze, at: 0.0}]"
    learning = simulate(load_scenario("paper", sets))
    still = simulate(load_scenario("paper", [*sets, freeze]))
    assert learning.info.status == still.info.status == "ok"
    assert rmse(learning) < rmse(still) / gain


@KINDS
def test_six_joints(make_scenario, kind):
    """dm_control's Kinova Jaco, with a motor for each joint."""
    jaco = Path(dm_control.__file__).parent / "third_party" / "kinova" / "jaco_arm.xml"
    mjcf = Mjcf.read(jaco)
    motors = "".join(f'<motor joint="joint_{k}"/>' for k in range(1, 7))
    off = '<option><flag damper="disable" constraint="disable"/></option><worldbody>'
    text = mjcf.text.replace("</mujoco>", f"<actuator>{motors}</actuator></mujoco>")
    text = text.replace("<worldbody>", off, 1)
    scenario = make_scenario(
        {"kind": kind},
        plant={"model": "jaco"},
        initial={"q": [0.0, 3.0, 3.0, 0.0, 0.0, 0.0]},
        reference={"kind": "sinusoid", "amplitude": 0.1, "offset": [0, 3, 3, 0, 0, 0]},
        duration=0.1,
    )
    controller = build_controller(scenario, Mjcf(text, mjcf.folder))
    inputs = Inputs.zeros(6)
    inputs.x_ref[:6] = inputs.x[:6] = scenario.initial.q
    inputs.x_ref[:6] += 0.1
    controller.reset(inputs.x)
    for _ in range(10):
        command = controller.update(inputs)
    assert np.all(np.isfinite(command.tau))
    assert np.all(command.tau != 0.0)
    assert controller.state()["W"].shape[1] == 6


@pytest.mark.parametrize(
    ("sets", "text"),
    [
        (["controller.kind=lewis_nn", "controller.K_v=[1, 2, 3]"], r"K_v = .*has 3 entries"),
        (["controller.kind=lewis_nn", "controller.hidden=0"], "hidden"),
        (["controller.kind=rbf_mso", "controller.box=[1, 2]"], r"box = .*has 2 entries"),
        (
            ["controller.kind=rbf_mso", "controller.inversion.effectiveness.kind=constant"],
            "leaves rbf_mso without a model",
        ),
    ],
)
def test_settings_that_make_no_sense_are_refused(sets, text):
    with pytest.raises(ScenarioError, match=text):
        load_scenario("paper", sets)
