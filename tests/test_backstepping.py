"""The backstepping law: its derivation term by term, its bound, drives with a lag, first rows."""

from __future__ import annotations

import math
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from worlds import DT, Run, World, arm, arm_flow, controller_of, drive

from dnnmso_mj.command_filter import build_filter, follow, start_filter
from dnnmso_mj.compiling import compiled
from dnnmso_mj.controllers import MODEL_ALONE, MODEL_FROZEN, Inputs
from dnnmso_mj.controllers.backstepping import BacksteppingController
from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.simulation import Simulation, simulate

Array = np.ndarray
LAG = 0.05
FULL = {"outputs": "full"}
BOLD = {"output_scale": 1.0}  # learns in 2 s what by default takes 6, and less smoothly


@pytest.fixture
def build(make_scenario, two_link):
    """A controller made of few words; by default with the backstepping law."""

    def _build(**controller: Any) -> BacksteppingController:
        scenario = make_scenario({"kind": "backstepping", **controller})
        return controller_of(scenario, two_link)

    return _build


# Command filter


@compiled
def _filtered(command, alphas, known, values):
    for k in range(alphas.size):
        if k == 0:
            start_filter(command, 0, alphas[0])
        values[k] = command.value[0]
        follow(command, 0, alphas[k], known)


@pytest.mark.parametrize("ahead", [False, True])
@pytest.mark.parametrize(("bandwidth", "dt"), [(20.0, 1e-3), (400.0, 0.01)])
def test_command_filter_has_two_poles_at_its_bandwidth_at_any_period(ahead, bandwidth, dt):
    """After a jump the error falls as e_{k+2} = 2β e_{k+1} − β² e_k with β = e^{−ω dt}."""
    command, decay = build_filter(bandwidth, 1, dt, ahead=ahead), math.exp(-bandwidth * dt)
    values = np.zeros(60)
    _filtered(command, np.append(0.0, np.ones(59)), 0.0, values)
    error = 1.0 - values[2:]
    assert np.allclose(error[2:], 2 * decay * error[1:-1] - decay**2 * error[:-2], atol=1e-14)
    assert abs(error[-1]) < abs(error[0])


@pytest.mark.parametrize(("ahead", "known"), [(False, 0.0), (False, 3.0), (True, 0.0)])
def test_command_filter_follows_a_ramp_without_error_at_once_where_its_rate_is_known(ahead, known):
    ramp = np.arange(2000) * DT * 3.0
    command, values = build_filter(50.0, 1, DT, ahead=ahead), np.zeros(2000)
    _filtered(command, ramp, known, values)
    # Ahead: `value` before a tick's `follow` is for the tick before.
    late = 3.0 * DT if ahead else 0.0
    settled = 1 if known else 1000
    assert np.allclose((values - ramp)[settled:], -late, atol=1e-9)
    assert command.rate[0] == pytest.approx(3.0)


# The derivation, term by term


def sampled_run(controller: BacksteppingController, lag: float | None, ticks: int) -> list[Any]:
    """A world whose every derivative is a difference, so that the derivation holds to rounding.

    ẋ₁ = x₂ + d₁(x), ẋ₂ = f₂(x) + B₂ τ, T τ̇ = τ_cmd − τ; what the law takes for f is far from it.
    """
    law, inputs = controller.law, Inputs.zeros(2)
    x, r, rd = np.array([0.5, 0.5, 0.0, 0.0]), np.array([0.0, 1.0]), np.array([0.5, 0.0])
    controller.reset(x)
    rows = []
    for k in range(ticks):
        rdd = np.sin(np.array([2.0, 3.0]) * k * DT)
        inputs.x[:], inputs.x_ref[:] = x, np.concatenate([r, rd])
        inputs.xd_ref[:] = np.concatenate([rd, rdd])
        cmd = controller.update(inputs).tau
        before = inputs.tau.copy()
        tau = cmd.copy() if lag is None else before + DT / (lag + DT) * (cmd - before)
        f = np.concatenate([x[2:] + np.sin(3 * x[:2]), 5.0 * np.cos(x[:2]) - x[2:] * abs(x[2:])])
        B2 = np.linalg.inv(law.B2_inv)
        w = [law.errors.w1.copy(), law.errors.w2.copy(), law.errors.z3.copy()]
        rows.append((w, f - law.drift, B2))
        x = x + DT * (f + np.concatenate([np.zeros(2), B2 @ tau]))
        r, rd = r + DT * rd, rd + DT * rdd
        inputs.tau[:] = tau
    return rows


@pytest.mark.parametrize("lag", [None, LAG])
@pytest.mark.parametrize("outputs", ["kinematic", "full"])
@pytest.mark.parametrize("effectiveness", [{"kind": "inertia"}, {"kind": "constant", "b": 0.7}])
def test_compensated_errors_obey_the_derivation_term_by_term(build, lag, outputs, effectiveness):
    """ẇ₁ = −K_q w₁ + w₂ + f̃₁, ẇ₂ = −K_v w₂ − w₁ + B₂ z₃ + f̃₂, ż₃ = −K_τ z₃ − B₂ᵀ w₂."""
    K_q, K_v, K_tau = np.array([6.0, 9.0]), np.array([11.0, 5.0]), np.array([40.0, 60.0])
    controller = build(
        K_q=K_q.tolist(),
        K_v=K_v.tolist(),
        K_tau=K_tau.tolist(),
        actuator_lag=lag,
        effectiveness=effectiveness,
        network={"outputs": outputs, "output_scale": 0.1},
    )
    rows = sampled_run(controller, lag, 600)
    largest = np.zeros(3)
    for (now, f_err, B2), (later, _, _) in pairwise(rows):
        (w1, w2, z3), (w1_next, w2_next, z3_next) = now, later
        rates = [-K_q * w1 + w2 + f_err[:2], -K_v * w2 - w1 + B2 @ z3_next + f_err[2:]]
        assert np.allclose(w1_next, w1 + DT * rates[0], rtol=0, atol=1e-9)
        assert np.allclose(w2_next, w2 + DT * rates[1], rtol=0, atol=1e-9)
        if lag is not None:
            rates.append(-K_tau * z3 - B2.T @ w2)
            assert np.allclose(z3_next, z3 + DT * rates[2], rtol=0, atol=1e-8)
        else:
            assert not z3.any()
        largest = np.maximum(largest, [np.abs(rate).max() for rate in [*rates, z3][:3]])
    assert (largest[:2] > 0.5).all()  # there was something to see
    assert largest[2] > 0.5 or lag is None


def test_two_steps_with_known_kinematics_are_an_inversion_with_pd_gains(build):
    """τ = M (q̈_ref − f̂₂ − (K_q + K_v) ė − (K_q K_v + 1) e): the paper's law and the term of e₁."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        controller = build(K_q=7.0, K_v=11.0, feedforward=False)
        x, x_ref, xd_ref = rng.normal(size=(3, 4))
        xd_ref[:2] = x_ref[2:]
        inputs = Inputs.zeros(2)._replace(x=x, x_ref=x_ref, xd_ref=xd_ref)
        controller.reset(x)
        command = controller.update(inputs)
        e, ed = x[:2] - x_ref[:2], x[2:] - x_ref[2:]
        qdd = xd_ref[2:] - command.f_hat[2:] - 18.0 * ed - 78.0 * e
        assert np.allclose(command.tau, controller.law.B2_inv @ qdd, rtol=1e-12)
        assert np.allclose(command.Bu, np.append([0.0, 0.0], qdd), rtol=1e-10)


# The bound


def bound_along_a_run(controller, lag: float, seconds: float, kappa: float) -> tuple[Array, Array]:
    """‖w‖ of each tick and the comparison solution W of Ẇ = −κ W + ‖f̃‖ with the true f̃.

    f̃ is the mean over the period, which is what a sampled law can know.
    """
    law, seen = controller.law, []

    def look(k: int, inputs: Inputs, tau: Array) -> None:
        errors, rd = law.errors, inputs.xd_ref[:2].copy()
        w = np.concatenate([errors.w1, errors.w2, errors.z3])
        e1 = inputs.x[:2] - inputs.x_ref[:2]
        Btau = np.linalg.solve(law.B2_inv, tau)
        slip = (tau - inputs.tau) / DT - (law.tau - inputs.tau) / (lag + DT)
        known = (rd - law.drift[:2], -Btau - law.drift[2:], slip if lag else np.zeros(2))
        seen.append((w, e1, inputs.x[2:].copy(), known))

    drive(controller, arm(), seconds, lag, look)
    w = np.array([np.linalg.norm(row[0]) for row in seen])
    bound = np.zeros(len(w))
    bound[0] = w[0]
    for k in range(len(w) - 1):
        (_, e1, x2, known), (_, e1_next, x2_next, _) = seen[k], seen[k + 1]
        f_err = ((e1_next - e1) / DT + known[0], (x2_next - x2) / DT + known[1], known[2])
        bound[k + 1] = (1 - kappa * DT) * bound[k] + DT * np.linalg.norm(np.concatenate(f_err))
    return w[:-1], bound[:-1]


@pytest.mark.parametrize(("lag", "network"), [(0.0, BOLD), (0.0, FULL), (LAG, {})])
def test_the_errors_keep_to_the_bound_while_the_network_learns(build, lag, network):
    """‖w‖ ≤ W, which settles at ε/κ; 5 % of κ is left to sampling."""
    controller = build(actuator_lag=lag or None, network=network)
    w, bound = bound_along_a_run(controller, lag, 2.0, 0.95 * 7.5)
    assert (w <= bound * (1 + 1e-9)).all()
    assert w[0] > 1.0
    assert w[-1] < 0.1 * w[0]


def test_no_better_bound_is_kept_than_the_one_derived(build):
    """With gains of twice what the law has, the same comparison fails: the bound is no idle one."""
    w, bound = bound_along_a_run(build(), 0.0, 1.0, 2 * 7.5)
    assert (w > bound).any()


# Drives with a lag


@pytest.fixture(scope="module")
def on_drives(make_scenario, two_link):
    """Runs of the arm on drives of a lag (s), each once: on_drives(lag, kind=…, …)."""

    @cache
    def _run(lag: float, kind: str = "backstepping", believed: float | None = None) -> Run:
        own = {} if kind == "dnn_mso" else {"actuator_lag": believed, "network": BOLD}
        return drive(controller_of(make_scenario({"kind": kind, **own}), two_link), arm(), 3.0, lag)

    return _run


def test_three_steps_track_through_a_lag_where_two_and_the_papers_law_do_not(on_drives):
    three, two = on_drives(LAG, believed=LAG), on_drives(LAG)
    paper = on_drives(LAG, kind="dnn_mso")
    assert three.rmse() < 1e-4
    assert two.rmse() > 3e-3
    # It takes its command for the torque that acts: a cycle that does not end.
    assert paper.rmse() > 3e-3
    assert paper.chatter() > 5 * three.chatter()
    assert np.abs(paper.tau).max() > 1.5 * np.abs(three.tau).max()


def test_a_lag_makes_no_difference_once_it_is_known(on_drives):
    errors = [on_drives(lag, believed=lag or None).rmse() for lag in (0.0, 0.03, LAG)]
    assert max(errors) < 1.5 * min(errors)


@pytest.mark.parametrize("believed", [0.8 * LAG, 1.25 * LAG])
def test_a_wrong_lag_costs_precision_and_not_stability(on_drives, believed):
    assert 3 * on_drives(LAG, believed=LAG).rmse() < on_drives(LAG, believed=believed).rmse() < 3e-3


# First rows that are not exact kinematics


def other_rows() -> World:
    """ẋ₁ = x₂ + ½ sin 2x₁ + 0.3, ẋ₂ = −2 x₂|x₂| − 4 sin x₁ + τ, each entry by itself."""

    def flow(x: Array, tau: Array) -> Array:
        x1, x2 = x[:2], x[2:]
        first = x2 + 0.5 * np.sin(2 * x1) + 0.3
        return np.concatenate([first, -2.0 * x2 * np.abs(x2) - 4.0 * np.sin(x1) + tau])

    return World(np.array([0.5, 0.5, 0.0, 0.0]), flow)


def test_first_rows_are_learned_where_exact_kinematics_would_be_wrong(build):
    known = {"effectiveness": {"kind": "constant", "b": 1.0}}
    assumed = drive(build(**known, feedforward=False), other_rows(), 3.0).rmse()
    learned = drive(build(**known, feedforward=False, network=FULL), other_rows(), 3.0).rmse()
    observed = drive(build(**known), other_rows(), 3.0).rmse()
    paper = {"kind": "dnn_mso", "inversion": known, "network": {"outputs": "kinematic"}}
    assert drive(build(**paper), other_rows(), 3.0).rmse() > 0.1
    assert assumed > 0.05
    assert learned < 1e-2 * assumed
    assert observed < 5e-2 * assumed


def test_a_biased_velocity_sensor_does_not_bend_the_path(build):
    """(K_q + K_v)/(K_q K_v + 1) of the bias is 0.013 rad, less what the network makes up for."""
    bold_full = {**FULL, **BOLD}
    trusting = drive(build(feedforward=False, network=BOLD), arm(0.05), 3.0).rmse()
    learning = drive(build(feedforward=False, network=bold_full), arm(0.05), 3.0).rmse()
    observing = drive(build(network=BOLD), arm(0.05), 3.0).rmse()
    through_a_lag = drive(build(network=BOLD, actuator_lag=LAG), arm(0.05), 3.0, LAG).rmse()
    assert trusting > 5e-3
    assert learning < 0.2 * trusting
    assert observing < 0.02 * trusting
    assert through_a_lag < 0.02 * trusting


# As a controller of the testbed


def told(rng: np.random.Generator) -> Inputs:
    x, x_ref, xd_ref = rng.normal(size=(3, 4))
    return Inputs.zeros(2)._replace(x=x, tau=rng.normal(size=2), x_ref=x_ref, xd_ref=xd_ref)


@pytest.mark.parametrize("lag", [None, LAG])
def test_it_goes_on_from_a_state_bit_for_bit(build, lag):
    one, other = (build(actuator_lag=lag, network=FULL) for _ in range(2))
    rng = np.random.default_rng(1)
    many = [told(rng) for _ in range(20)]
    one.reset(many[0].x)
    for inputs in many[:10]:
        one.update(inputs)
    state = one.state()
    other.update(many[3])  # a past of its own
    other.restore(state)
    for inputs in many[10:]:
        expected = one.update(inputs)
        found = other.update(inputs)
        for name in ("tau", "Bu", "x_hat", "f_hat", "e_obs"):
            assert np.array_equal(getattr(found, name), getattr(expected, name)), name


def test_reset_forgets_the_last_run(build):
    rng = np.random.default_rng(2)
    many = [told(rng)._replace(frozen=np.array([MODEL_FROZEN])) for _ in range(6)]
    controller = build(actuator_lag=LAG)
    runs = []
    for _ in range(2):
        controller.reset(many[0].x)
        runs.append([controller.update(inputs).tau.copy() for inputs in many])
    assert np.array_equal(*runs)


def test_a_frozen_model_stays_and_alone_it_goes_without_the_observers_correction(build):
    controller, rng = build(), np.random.default_rng(3)
    controller.reset(np.zeros(4))
    for _ in range(3):
        controller.update(told(rng))
    state, inputs = controller.state(), told(rng)
    taus = []
    for frozen in (MODEL_FROZEN, MODEL_ALONE):
        controller.restore(state)
        inputs.frozen[0] = frozen
        command = controller.update(inputs)
        taus.append(command.tau.copy())
        assert np.array_equal(controller.state()["weights"], state["weights"])
        correction = controller.law.drift - command.f_hat
        expected = 30.0 * command.e_obs if frozen == MODEL_FROZEN else np.zeros(4)
        assert np.allclose(correction, expected, atol=1e-12)
    assert not np.allclose(*taus)
    inputs.frozen[0] = 0
    controller.restore(state)
    controller.update(inputs)
    assert not np.array_equal(controller.state()["weights"], state["weights"])


def test_the_observer_takes_the_torque_that_acted(build):
    """X̂ moves by dt (f̂ + B τ + K₂ e_a) with the τ that the drives report, not with the command."""
    for torque in ("applied", "commanded"):
        controller = build(observer={"torque": torque}, network=FULL)
        rng = np.random.default_rng(4)
        first, second = told(rng), told(rng)
        controller.reset(first.x)
        one = controller.update(first)
        B2_inv, f_hat, e_obs = controller.law.B2_inv.copy(), one.f_hat.copy(), one.e_obs.copy()
        x_hat, acted = one.x_hat.copy(), second.tau if torque == "applied" else one.tau.copy()
        two = controller.update(second)
        B_tau = np.append([0.0, 0.0], np.linalg.solve(B2_inv, acted))
        expected = x_hat + DT * (f_hat + B_tau + 30.0 * e_obs)
        assert np.allclose(two.x_hat, expected, rtol=1e-12)


def test_the_first_rows_of_the_model_are_the_velocity_and_what_is_learned_beside_it(build):
    inputs = told(np.random.default_rng(5))
    for network in ({}, FULL):
        controller = build(network=network)
        learned = controller.dynamics(inputs.x)
        f_hat = controller.update(inputs).f_hat
        assert np.allclose(f_hat[2:], learned)
        assert np.array_equal(f_hat[:2], inputs.x[2:]) == (network == {})


class Wrapped:
    """The same controller, hidden from the compiled loop."""

    def __init__(self, controller):
        self._controller = controller

    def __getattr__(self, name):
        return getattr(self._controller, name)

    def update(self, inputs):
        return self._controller.update(inputs)


def test_interpreted_and_compiled_loop_give_the_same_run(make_scenario, two_link):
    scenario = make_scenario({"kind": "backstepping", "actuator_lag": LAG}, duration=0.4)
    simulation = Simulation(scenario, two_link)
    simulation.controller = Wrapped(simulation.controller)
    recorder = MemoryRecorder(simulation.layout, scenario.n_ticks)
    interpreted = recorder.trace(scenario, simulation.run(recorder))
    compiled_run = simulate(scenario, two_link)
    for name in ("q", "tau", "f_hat", "f_true", "e_obs", "weight_norm"):
        assert np.array_equal(interpreted[name], compiled_run[name]), name


def test_torchs_network_gives_the_same_torques(build):
    precise = {"precision": "float64", "outputs": "full"}
    kernel, torch = build(network=precise), build(network={**precise, "backend": "torch"})
    rng = np.random.default_rng(6)
    for _ in range(5):
        inputs = told(rng)
        assert np.allclose(kernel.update(inputs).tau, torch.update(inputs).tau, rtol=1e-8)


@pytest.mark.parametrize(
    ("setting", "problem"),
    [
        ("K_q=[1, 2, 3]", "has 3 entries; allowed: 1 or 2"),
        ("K_tau=2000", "allowed: K_tau < 2/dt = 2000"),
        ("actuator_lag=0", "actuator_lag"),
        ("filter_v=0", "filter_v"),
    ],
)
def test_settings_that_make_no_sense_are_refused(setting, problem):
    with pytest.raises(ScenarioError, match=problem.replace("(", r"\(")):
        load_scenario("paper", ["controller.kind=backstepping", f"controller.{setting}"])


def test_the_worlds_arm_is_the_testbeds(make_scenario, two_link):
    """What the worlds above show holds for MuJoCo's arm: the same torques, the same motion."""
    run = drive(controller_of(make_scenario({"kind": "backstepping"}), two_link), arm(), 0.3)
    trace = simulate(make_scenario({"kind": "backstepping"}, duration=0.3), two_link)
    assert np.allclose(run.x[:, :2], trace["q"], atol=1e-9)
    assert np.allclose(
        arm_flow(run.x[50], run.tau[50])[2:], (run.x[51] - run.x[50])[2:] / DT, rtol=0.05
    )
