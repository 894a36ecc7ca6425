"""Rivals without learning: each law against its closed form, or against what its source shows."""

from __future__ import annotations

import numpy as np
import pytest

from dnnmso_mj.controllers import LEARNING, MODEL_ALONE, Inputs, build_controller
from dnnmso_mj.controllers.adrc import observer_gain
from dnnmso_mj.dynamics import TwoLink
from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.simulation import Simulation, simulate
from tests.test_compiled_loop import CLOCKED, Wrapped
from tests.test_simulate import chain

ARM = TwoLink((1.0, 2.3), (1.0, 1.0))
WRONG = {"kind": "inertia", "masses": [1.3, 1.8], "lengths": [1.0, 1.1]}
KINDS = ["pd", "pid", "computed_torque", "adrc", "sliding_mode", "rise", "l1"]
every_kind = pytest.mark.parametrize("kind", KINDS)
REST = (0.4, -0.3)  # rad


def at_rest(make_scenario, controller, **parts):
    """A scenario that holds the arm at REST, where it starts."""
    reference = {"kind": "setpoint", "start": REST, "goal": REST, "blend_time": 1.0}
    return make_scenario(controller, initial={"q": REST}, reference=reference, **parts)


def final(trace):
    """Error (n,) rad and angle (n,) rad of the last tick, which must be at rest."""
    assert trace.info.status == "ok"
    assert np.abs(trace["qd"][-1]).max() < 1e-6
    return trace["q"][-1] - trace["q_ref"][-1], trace["q"][-1]


def run_with(scenario, mjcf, wrap):
    """The trace of a scenario whose controller is put in `wrap` first."""
    controller = wrap(build_controller(scenario, mjcf))
    simulation = Simulation(scenario, mjcf, controller=controller)
    recorder = MemoryRecorder(simulation.layout, scenario.n_ticks)
    return recorder.trace(scenario, simulation.run(recorder))


class Unaware(Wrapped):
    """A controller that is told that its last command acted, whatever the drives gave."""

    def reset(self, x):
        self._asked = np.zeros(x.size // 2)
        self._controller.reset(x)

    def update(self, inputs):
        command = self._controller.update(inputs._replace(tau=self._asked))
        self._asked = command.tau.copy()
        return command


# PD and PID


def test_pd_leaves_gravity_over_its_gain_and_no_inertia_enters(make_scenario):
    gains = {"kp": [800.0, 300.0], "kd": [150.0, 60.0]}
    trace = simulate(at_rest(make_scenario, {"kind": "pd", **gains}, duration=5.0))
    e, q = final(trace)
    assert np.allclose(e, -ARM.gravity_torque(q) / gains["kp"], rtol=1e-6)
    assert np.abs(e).min() > 0.01


def test_pid_removes_that_error_and_its_integral_becomes_the_torque_of_gravity(make_scenario):
    trace = simulate(at_rest(make_scenario, {"kind": "pid"}, duration=15.0))
    e, q = final(trace)
    assert np.abs(e).max() < 1e-8
    assert np.allclose(trace["tau"][-1], ARM.gravity_torque(q), atol=1e-5)


def test_pid_does_not_wind_up_at_a_torque_limit(make_scenario, two_link):
    """A step that saturates for long: without news of the acted torque it overshoots far more."""
    start, goal = [-1.5, 0.0], [0.0, 0.0]
    scenario = make_scenario(
        {"kind": "pid"},
        initial={"q": start},
        reference={"kind": "setpoint", "start": start, "goal": goal, "blend_time": 0.1},
        imperfections={"torque_limit": [75.0, 40.0]},
        duration=6.0,
    )
    told, unaware = simulate(scenario), run_with(scenario, two_link, Unaware)
    assert told["saturated"].mean() > 0.02
    overshoot = [trace["q"][:, 0].max() for trace in (told, unaware)]
    assert overshoot[0] < 0.5 * overshoot[1]


# Computed torque


def test_with_the_true_model_the_error_obeys_its_linear_equation(make_scenario, two_link):
    """ë + K_d ė + K_p e = 0 at any state and reference."""
    gains = {"kp": [50.0, 30.0], "kd": [9.0, 12.0]}
    scenario = make_scenario({"kind": "computed_torque", **gains})
    controller = build_controller(scenario, two_link)
    for x, x_ref, xd_ref in np.random.default_rng(0).normal(size=(20, 3, 4)):
        inputs = Inputs(x, np.zeros(2), x_ref, xd_ref, np.zeros(1, np.int64))
        command = controller.update(inputs)
        e, edd = x - x_ref, ARM.acceleration(x[:2], x[2:], command.tau) - xd_ref[2:]
        assert np.allclose(edd + gains["kd"] * e[2:] + gains["kp"] * e[:2], 0.0, atol=1e-9)
        drift = ARM.acceleration(x[:2], x[2:], np.zeros(2))
        assert np.allclose(command.f_hat, [*x[2:], *drift], atol=1e-10)
        assert np.allclose(controller.dynamics(x), drift, atol=1e-10)


def test_computed_torque_follows_the_analytic_solution_to_a_millionth(make_scenario):
    """e = (e₀ + (ė₀ + ω e₀) t) exp(−ω t), once the hold of the torque is extrapolated away."""
    w = 7.5
    runs = [
        simulate(make_scenario({"kind": "computed_torque"}, duration=1.0, dt=dt))
        for dt in (2e-4, 1e-4)
    ]
    t = runs[0]["t"]
    (e, ed), half = (
        [runs[0][name] - runs[0][f"{name}_ref"] for name in ("q", "qd")],
        (runs[1]["q"] - runs[1]["q_ref"])[::2],
    )
    exact = (e[0] + (ed[0] + w * e[0]) * t[:, None]) * np.exp(-w * t)[:, None]
    assert np.abs(2.0 * half - e - exact).max() < 1e-6
    assert 1e-5 < np.abs(e - exact).max() < 1e-3
    assert np.abs(half - exact).max() == pytest.approx(0.5 * np.abs(e - exact).max(), rel=0.01)


def test_a_wrong_model_leaves_the_error_that_its_gravity_predicts(make_scenario):
    controller = {"kind": "computed_torque", "effectiveness": WRONG}
    e, q = final(simulate(at_rest(make_scenario, controller, duration=5.0)))
    believed = TwoLink(tuple(WRONG["masses"]), tuple(WRONG["lengths"]))
    short = believed.gravity_torque(q) - ARM.gravity_torque(q)
    assert np.allclose(56.25 * e, np.linalg.solve(believed.inertia(q), short), rtol=1e-6)
    assert np.abs(e).max() > 0.01


# ADRC


@pytest.mark.parametrize("bandwidth", [5.0, 75.0, 900.0])
def test_the_three_poles_of_the_sampled_observer_are_at_its_bandwidth(bandwidth):
    dt = 1e-3
    gain = observer_gain(np.array([bandwidth]), dt)
    predict = np.array([[1.0, dt, 0.5 * dt**2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    error = (np.eye(3) - gain @ [[1.0, 0.0, 0.0]]) @ predict
    assert np.allclose(np.poly(error), np.poly([np.exp(-bandwidth * dt)] * 3), atol=1e-12)


def test_the_sampled_gains_become_those_of_continuous_time():
    """[3 ω, 3 ω², ω³], Gao's, as dt → 0."""
    w, dt = 40.0, 1e-7
    gain = observer_gain(np.array([w]), dt)[:, 0] / dt
    assert np.allclose(gain, [3 * w, 3 * w**2, w**3], rtol=1e-4)


@pytest.mark.parametrize("believed", [{"kind": "inertia"}, WRONG])
def test_z3_finds_the_total_disturbance_at_rest_and_no_error_is_left(make_scenario, believed):
    controller = {"kind": "adrc", "effectiveness": believed}
    trace = simulate(at_rest(make_scenario, controller, duration=5.0))
    e, _ = final(trace)
    assert np.abs(trace["f_true"][-1, 2:]).max() > 5.0
    assert np.allclose(trace["f_hat"][-1], trace["f_true"][-1], atol=1e-6)
    assert np.abs(e).max() < 1e-8


def test_z3_lags_a_moving_disturbance_by_three_time_constants(make_scenario):
    trace = simulate(make_scenario({"kind": "adrc"}))
    steady = slice(2000, None)
    f_true, z3 = trace["f_true"][steady, 2:], trace["f_hat"][steady, 2:]
    rate = np.gradient(f_true, 1e-3, axis=0)
    assert np.abs(f_true - z3 - 3.0 / 75.0 * rate).max() < 0.1 * np.abs(f_true - z3).max()


def test_the_observer_needs_the_torque_that_acted(make_scenario, two_link):
    limit = {"torque_limit": 45.0}
    scenario = make_scenario({"kind": "adrc"}, imperfections=limit, duration=0.5)
    told, unaware = simulate(scenario), run_with(scenario, two_link, Unaware)
    assert told["saturated"].sum() > 50
    wrong = [np.abs(run["f_hat"] - run["f_true"]).max() for run in (told, unaware)]
    assert wrong[0] < 0.5 * wrong[1]


# Sliding mode


def surface(trace, lam=7.5):
    """s = ė + λ e (N, n)."""
    return trace["qd"] - trace["qd_ref"] + lam * (trace["q"] - trace["q_ref"])


def test_s_reaches_its_layer_in_the_time_predicted_and_stays_in_the_one_that_is_due(make_scenario):
    """(|s₀| − φ)/(k − F), then φ, and in the end φ F/k."""
    k, layer = 40.0, 0.4
    trace = simulate(make_scenario({"kind": "sliding_mode"}))
    s, F = np.abs(surface(trace)), np.abs(trace["f_true"][:, 2:]).max(axis=0)
    assert (k > F).all()
    assert (s[0] > 2 * layer).all()
    for i in range(2):
        reach = (s[0, i] - layer) / (k - F[i])
        assert s[trace["t"] >= reach, i].max() <= layer
        late = trace["t"] >= reach + 10 * layer / k
        assert s[late, i].max() <= layer * F[i] / k * 1.001 + 1e-4
        e = np.abs(trace["q"] - trace["q_ref"])[:, i]
        assert e[trace["t"] > 3.0].max() <= layer * F[i] / (k * 7.5) * 1.001 + 1e-5


def test_too_small_a_gain_does_not_hold_s_in_its_layer(make_scenario):
    trace = simulate(make_scenario({"kind": "sliding_mode", "gain": 5.0}))
    assert np.abs(surface(trace))[5000:].max() > 1.0


# RISE


def worst(trace, start, end):
    t = trace["t"]
    error = np.abs(trace["q"] - trace["q_ref"])
    return error[(t >= start) & (t < end)].max()


def test_rise_starts_without_torque_goes_on_shrinking_its_error_and_never_jumps(make_scenario):
    trace = simulate(make_scenario({"kind": "rise"}, duration=8.0))
    assert np.array_equal(trace["tau"][0], [0.0, 0.0])
    errors = [worst(trace, start, start + 1.0) for start in (1.0, 2.0, 3.0)]
    assert errors[1] < 0.3 * errors[0]
    assert errors[2] < 0.3 * errors[1]
    assert worst(trace, 6.0, 8.0) < 2e-4
    jump = np.abs(np.diff(trace["tau"][1000:], axis=0)).max()
    assert jump < 0.2  # N·m a tick, of a torque of 50


def test_what_is_left_is_of_sampling_and_without_the_sign_an_error_stays(make_scenario):
    fine, without = (
        simulate(make_scenario({"kind": "rise", **setting}, duration=8.0, dt=dt))
        for setting, dt in (({}, 2.5e-4), ({"beta": 1e-9}, 1e-3))
    )
    sampled = simulate(make_scenario({"kind": "rise"}, duration=8.0))
    left = [worst(trace, 6.0, 8.0) for trace in (fine, sampled, without)]
    assert left[0] < 0.5 * left[1]
    assert left[2] > 20.0 * left[1]


# L1


def l1_on_a_point(make_scenario, two_link, sigma, n_ticks):
    """σ̂ and u of every tick (n_ticks, 2), with a plant q̈ = τ + σ that is constant in a period."""
    constant = {"kind": "constant", "b": 1.0}
    controller = {"kind": "l1", "predictor_gain": 10.0, "effectiveness": constant}
    law = build_controller(make_scenario(controller), two_link)
    inputs, rows = Inputs.zeros(2), []
    law.reset(inputs.x)
    for _ in range(n_ticks):
        command = law.update(inputs)
        state = law.state()
        rows.append((state["sigma"], state["u"]))
        inputs.tau[:] = command.tau
        inputs.x[2:] += 1e-3 * (command.tau + sigma)
    return np.array(rows).transpose(1, 0, 2)


def test_l1_finds_a_constant_in_one_period_and_its_filter_lets_it_in(make_scenario, two_link):
    """σ̂ = exp(−a dt) σ from the first period on, and u = −σ̂ (1 − exp(−ω_f t))."""
    sigma = np.array([3.0, -20.0])
    found, u = l1_on_a_point(make_scenario, two_link, sigma, 200)
    assert np.allclose(found[0], 0.0)
    assert np.allclose(found[1:], np.exp(-10.0 * 1e-3) * sigma, rtol=1e-9)
    t = 1e-3 * np.arange(200)[:, None]
    assert np.allclose(u, -np.exp(-0.01) * sigma * -np.expm1(-75.0 * t), rtol=1e-9)


@pytest.mark.parametrize("mass", [1.0, 2.3, 8.0])
def test_l1s_prediction_error_is_bounded_by_the_period_whatever_the_plant(make_scenario, mass):
    """|ṽ| ≤ Φ max|σ|, so half the period halves it: the published performance bound."""
    peaks = []
    for dt in (1e-3, 5e-4):
        plant = {"masses": [1.0, mass], "lengths": [1.0, 1.0]}
        trace = simulate(make_scenario({"kind": "l1"}, plant=plant, dt=dt, duration=3.0))
        found = np.abs(trace["e_obs"][:, 2:]).max(axis=0)
        assert (found <= dt * np.abs(trace["f_true"][:, 2:]).max(axis=0) * 1.001).all()
        assert np.abs(trace["tau"]).max() < 100.0 * (1.0 + mass)
        peaks.append(found)
    assert np.allclose(peaks[1], 0.5 * peaks[0], rtol=0.02)


def test_a_faster_filter_leaves_less_error_in_proportion(make_scenario):
    """What passes is (1 − C(s)) σ, of size σ̇/ω_f."""
    settings = ({"filter_bandwidth": 20.0}, {"filter_bandwidth": 100.0})
    slow, fast = (simulate(make_scenario({"kind": "l1", **setting})) for setting in settings)
    assert worst(slow, 5.0, 10.0) == pytest.approx(5.0 * worst(fast, 5.0, 10.0), rel=0.25)


# All of them


def test_every_one_tracks_the_papers_motion_better_than_no_network_does(make_scenario):
    loose = compute_metrics(simulate(make_scenario({"kind": "no_network"})))["rmse_steady"]
    for kind in KINDS:
        metrics = compute_metrics(simulate(make_scenario({"kind": kind})))
        assert metrics["rmse_steady"] < 0.3 * loose, kind
        assert not metrics["diverged"], kind
        assert metrics["tau_chatter"] < 0.05, kind


@every_kind
@pytest.mark.parametrize("shipped", ["rods", "setpoint", "waypoints"])
def test_it_drives_every_shipped_arm_and_motion(kind, shipped):
    trace = simulate(load_scenario(shipped, [f"controller={{kind: {kind}}}"]))
    assert trace.info.status == "ok"
    assert np.abs(trace["q"] - trace["q_ref"])[-1000:].max() < 0.15


@every_kind
def test_it_drives_three_joints(make_scenario, kind):
    q = [0.1, 0.2, -0.1]
    scenario = make_scenario(
        {"kind": kind},
        plant={"model": "chain.xml"},
        initial={"q": q},
        reference={"kind": "setpoint", "start": q, "goal": [0.3, 0.1, 0.2], "blend_time": 1.0},
        duration=2.0,
    )
    trace = simulate(scenario, chain(3))
    assert trace.info.status == "ok"
    assert np.abs(trace["q"] - trace["q_ref"])[-1].max() < 0.2


@every_kind
@pytest.mark.parametrize("limit", [None, 40.0])
def test_interpreted_and_compiled_loop_give_the_same_run(make_scenario, two_link, kind, limit):
    parts = {"duration": 1.0, "imperfections": {"torque_limit": limit}}
    scenario = make_scenario({"kind": kind}, **parts)
    interpreted, compiled = run_with(scenario, two_link, Wrapped), simulate(scenario)
    for name in set(compiled) - CLOCKED:
        assert np.array_equal(interpreted[name], compiled[name]), name


def some_inputs(rng, frozen=LEARNING):
    x, x_ref, xd_ref = rng.normal(size=(3, 4))
    return Inputs(x, rng.normal(size=2), x_ref, xd_ref, np.array([frozen]))


@every_kind
def test_a_restored_state_goes_on_as_the_one_it_was_taken_of(make_scenario, two_link, kind):
    one, other = (build_controller(make_scenario({"kind": kind}), two_link) for _ in range(2))
    rng = np.random.default_rng(1)
    one.reset(rng.normal(size=4))
    for _ in range(10):
        one.update(some_inputs(rng))
    state = one.state()
    kept = {name: values.copy() for name, values in state.items()}
    other.update(some_inputs(rng))
    other.restore(state)
    for _ in range(10):
        inputs = some_inputs(rng)
        one.dynamics(rng.normal(size=4))  # has no side effect
        for here, there in zip(one.update(inputs)[:5], other.update(inputs)[:5], strict=True):
            assert np.array_equal(here, there)
    one.reset(np.zeros(4))
    other.reset(np.zeros(4))
    inputs = some_inputs(rng)
    assert np.array_equal(one.update(inputs).tau, other.update(inputs).tau)
    assert all(np.array_equal(state[name], kept[name]) for name in kept)


@every_kind
def test_to_freeze_the_model_changes_nothing_where_nothing_is_learned(make_scenario, kind):
    freeze = {"kind": "freeze", "at": 0.5, "what": "model"}
    frozen = simulate(make_scenario({"kind": kind}, duration=1.0, events=[freeze]))
    free = simulate(make_scenario({"kind": kind}, duration=1.0))
    assert np.array_equal(frozen["tau"], free["tau"])


@pytest.mark.parametrize("kind", ["adrc", "l1"])
def test_alone_without_an_estimate_the_drift_is_an_error_again(make_scenario, kind):
    """K_p e = f₂ = −M⁻¹ G, with K_p = ω² = 7.5²."""
    freeze = {"kind": "freeze", "at": 2.0, "what": "all"}
    trace = simulate(at_rest(make_scenario, {"kind": kind}, duration=7.0, events=[freeze]))
    assert np.abs(trace["q"] - trace["q_ref"])[1999].max() < 2e-4
    e, q = final(trace)
    assert np.allclose(
        56.25 * e, -np.linalg.solve(ARM.inertia(q), ARM.gravity_torque(q)), rtol=1e-5
    )
    assert np.array_equal(trace["f_hat"][-1, 2:], [0.0, 0.0])


@pytest.mark.parametrize(("kind", "integral"), [("pid", "integral"), ("rise", "nu")])
def test_alone_an_integral_keeps_its_value(make_scenario, two_link, kind, integral):
    controller = build_controller(make_scenario({"kind": kind}), two_link)
    rng = np.random.default_rng(2)
    controller.reset(np.zeros(4))
    for _ in range(3):
        controller.update(some_inputs(rng))
    before = controller.state()[integral]
    controller.update(some_inputs(rng, MODEL_ALONE))
    assert np.array_equal(controller.state()[integral], before)
    controller.update(some_inputs(rng))
    assert not np.array_equal(controller.state()[integral], before)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "computed_torque"])
def test_it_knows_no_drift(make_scenario, two_link, kind):
    controller = build_controller(make_scenario({"kind": kind}), two_link)
    assert np.array_equal(controller.dynamics(np.ones(4)), [0.0, 0.0])


def test_a_gain_for_too_many_joints_is_refused_by_name():
    with pytest.raises(ScenarioError, match=r"controller\.kp.*3 entries.*allowed: 1 or 2"):
        load_scenario("paper", ["controller={kind: pd, kp: [1.0, 2.0, 3.0]}"])


def test_half_a_model_is_refused_by_its_own_key_path(make_scenario):
    half = {"kind": "adrc", "effectiveness": {"kind": "inertia", "masses": [1.0, 1.0]}}
    scenario = make_scenario(half, plant={"model": "chain.xml"})
    with pytest.raises(ScenarioError, match=r"^controller\.effectiveness: masses or lengths"):
        simulate(scenario, chain(2))
