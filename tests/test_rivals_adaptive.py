"""Adaptive controllers: regressor, Lyapunov function, what is learned and what is remembered."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from test_compiled_loop import CLOCKED, Wrapped

from dnnmso_mj import history_stack as stacks
from dnnmso_mj.controllers import Inputs
from dnnmso_mj.dynamics import TwoLink
from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.plant import Mjcf, NominalModel
from dnnmso_mj.reference import Reference
from dnnmso_mj.regressor import drift, momentum, momentum_loss, regressor
from dnnmso_mj.scenario.adaptive import N_PARAMETERS
from dnnmso_mj.simulation import Simulation, simulate

KINDS = ("slotine_li", "concurrent_learning")
LINKS = ("point_mass", "rod")
REST = {"kind": "setpoint", "start": [0.5, 0.5], "goal": [1.0, 0.2], "blend_time": 1.0}
MOVING = {"kind": "sinusoid", "frequency": [2.0, 3.0]}
SHORT = {  # moves for 3 s, then rests
    "kind": "waypoints",
    "times": [0.0, 0.7, 1.4, 2.2, 3.0],
    "points": [[0.5, 0.5], [1.5, -0.5], [0.2, 1.0], [1.2, 0.3], [0.8, 0.8]],
}

arms = st.builds(
    TwoLink,
    masses=st.tuples(st.floats(0.1, 10), st.floats(0.1, 10)),
    lengths=st.tuples(st.floats(0.2, 2), st.floats(0.2, 2)),
    gravity=st.floats(0, 20),
    links=st.sampled_from(LINKS),
)
pairs = st.tuples(st.floats(-4, 4), st.floats(-4, 4)).map(np.array)
frictions = st.tuples(st.floats(0, 5), st.floats(0, 5)).map(np.array)


def parameters(arm: TwoLink, friction=(0.0, 0.0)) -> np.ndarray:
    """θ of an arm, read off M and G at chosen poses."""
    right = np.pi / 2
    M = arm.inertia(np.zeros(2))
    p1, p3 = arm.inertia(np.array([0.0, right]))[0, 0], M[1, 1]
    g1 = arm.gravity_torque(np.array([0.0, right]))[0]
    g2 = arm.gravity_torque(np.array([right, -right]))[1]
    return np.array([p1, M[0, 1] - p3, p3, g1, g2, *friction])


def rows(fill, *arguments) -> np.ndarray:
    Y = np.full((2, N_PARAMETERS), np.nan)
    fill(*arguments, Y)
    return Y


@settings(deadline=None)  # the first example compiles
@given(arms, frictions, pairs, pairs, pairs, pairs)
def test_the_regressor_is_the_arm(arm, friction, q, qd, v, a):
    Y = rows(regressor, np.concatenate([q, qd]), v, a)
    V = arm.coriolis_matrix(q, qd)
    expected = arm.inertia(q) @ a + V @ v + arm.gravity_torque(q) + friction * v
    scale = 1 + np.abs(expected).max() + np.abs(parameters(arm)).max() * 100
    assert np.abs(Y @ parameters(arm, friction) - expected).max() <= 1e-12 * scale


@settings(deadline=None)  # the first example compiles
@given(arms, frictions, pairs, pairs)
def test_momentum_and_its_loss_are_the_same_motion_without_acceleration(arm, friction, q, qd):
    x, theta = np.concatenate([q, qd]), parameters(arm, friction)
    V = arm.coriolis_matrix(q, qd)
    scale = 1 + np.abs(theta).max() * (1 + qd @ qd)
    assert np.allclose(rows(momentum, x) @ theta, arm.inertia(q) @ qd, rtol=0, atol=1e-12 * scale)
    loss = -V.T @ qd + arm.gravity_torque(q) + friction * qd
    assert np.allclose(rows(momentum_loss, x) @ theta, loss, rtol=0, atol=1e-11 * scale)


@settings(deadline=None)  # the first example compiles
@given(arms, pairs, pairs, pairs)
def test_inertia_rate_minus_twice_coriolis_is_skew_in_the_regressor(arm, q, qd, v):
    """vᵀ (Ṁ − 2C) v = 0, with Ṁ v from M at two moments and C v from Y(q, q̇, v, 0)."""
    h, theta, still = 1e-6, parameters(arm), np.zeros(2)
    theta[3:] = 0.0
    M_v = [rows(regressor, np.concatenate([q + s * h * qd, still]), still, v) for s in (1, -1)]
    rate = (M_v[0] - M_v[1]) @ theta / (2 * h)
    C_v = rows(regressor, np.concatenate([q, qd]), v, still) @ theta
    assert abs(v @ (rate - 2 * C_v)) <= 1e-6 * (1 + theta.max()) * (1 + v @ v) * (1 + qd @ qd)


@pytest.mark.parametrize("links", LINKS)
def test_mujoco_is_explained_by_the_parameters_of_the_arm(make_scenario, two_link, links):
    rng = np.random.default_rng(0)
    for _ in range(5):
        masses, lengths = rng.uniform(0.2, 5.0, 2).tolist(), rng.uniform(0.3, 2.0, 2).tolist()
        plant = {"links": links, "masses": masses, "lengths": lengths}
        model = NominalModel(make_scenario(plant=plant), two_link)
        theta = parameters(TwoLink(tuple(masses), tuple(lengths), 9.81, links))
        for _ in range(20):
            q, qd, a = rng.uniform(-3, 3, size=(3, 2))
            x = np.concatenate([q, qd])
            M, bias = model.inertia(q).copy(), model.bias(q, qd).copy()
            scale = np.abs(M).max() * 30 + np.abs(bias).max()
            torque = rows(regressor, x, qd, a) @ theta
            assert np.abs(torque - M @ a - bias).max() <= 1e-10 * scale
            f_hat = np.zeros(2)
            drift(theta, x, f_hat)
            assert np.allclose(f_hat, -np.linalg.solve(M, bias), rtol=1e-8, atol=1e-8)


def test_no_drift_is_told_of_estimates_that_are_no_inertia():
    out = np.ones(2)
    drift(np.array([1.0, 2.0, 0.5, 9.0, 9.0, 0.0, 0.0]), np.zeros(4), out)
    assert not out.any()


def drive(simulation: Simulation, seconds: float, first: int = 0):
    """Run a simulation's controller on its plant by hand; yields its inputs after each tick."""
    scenario, plant, controller = simulation.scenario, simulation.plant, simulation.controller
    reference, inputs = Reference(scenario.reference, 2), Inputs.zeros(2)
    if first == 0:
        plant.reset(scenario.initial.q, np.zeros(2))
        controller.reset(np.concatenate([plant.q, plant.qd]))
    for k in range(first, first + round(seconds / scenario.dt)):
        q_ref, qd_ref, qdd_ref = (r[0] for r in reference.sample(np.array([k * scenario.dt])))
        inputs.x[:] = np.concatenate([plant.q, plant.qd])
        inputs.x_ref[:], inputs.xd_ref[:] = [*q_ref, *qd_ref], [*qd_ref, *qdd_ref]
        inputs.tau[:] = controller.update(inputs).tau
        yield inputs
        plant.step(inputs.tau)


def law(simulation: Simulation):
    return simulation.controller._parts.law


ARM = TwoLink((1.0, 2.3), (1.0, 1.0))
THETA = parameters(ARM)


def parameter_error(simulation: Simulation) -> float:
    return float(np.abs(law(simulation).theta - THETA).max())


def lyapunov(make_scenario, two_link, sign: float, seconds: float) -> np.ndarray:
    """½ sᵀMs + ½ θ̃ᵀΓ⁻¹θ̃ at every tick, with adaptation or (sign −1) its opposite."""
    simulation = Simulation(make_scenario({"kind": "slotine_li"}), two_link)
    Gamma = law(simulation).Gamma.copy()
    law(simulation).Gamma[:] *= sign
    values = []
    error = law(simulation).theta - THETA
    for inputs in drive(simulation, seconds):
        s, M = law(simulation).s, ARM.inertia(inputs.x[:2])
        values.append(0.5 * s @ M @ s + 0.5 * (error**2 / Gamma).sum())
        error = law(simulation).theta - THETA
    return np.array(values)


def test_the_lyapunov_function_falls_at_every_tick(make_scenario, two_link):
    V = lyapunov(make_scenario, two_link, 1.0, 2.0)
    assert np.diff(V).max() < 0.0
    assert V[-1] < 0.5 * V[0]


def test_the_lyapunov_function_grows_with_the_adaptation_turned_round(make_scenario, two_link):
    V = lyapunov(make_scenario, two_link, -1.0, 0.3)
    assert V[-1] > 2.0 * V[0]


def test_slotine_li_tracks_without_finding_the_parameters(make_scenario, two_link):
    simulation = Simulation(make_scenario({"kind": "slotine_li"}, reference=REST), two_link)
    errors = [np.abs((inputs.x - inputs.x_ref)[:2]).max() for inputs in drive(simulation, 15.0)]
    assert max(errors) > 0.1
    assert errors[-1] < 1e-3
    assert parameter_error(simulation) > 0.5


def test_concurrent_learning_finds_the_parameters_and_goes_on_at_rest(make_scenario, two_link):
    scenario = make_scenario({"kind": "concurrent_learning"}, reference=SHORT)
    simulation = Simulation(scenario, two_link)
    *_, _ = drive(simulation, 3.0)
    at_stop = parameter_error(simulation)
    *_, resting = drive(simulation, 6.0, first=3000)
    assert np.abs(resting.x_ref[2:]).max() == 0.0
    assert parameter_error(simulation) < 0.05 * at_stop
    assert parameter_error(simulation) < 1e-2
    x = np.array([0.3, -0.8, 1.0, 2.0])
    f_hat = simulation.controller.dynamics(x)
    assert np.allclose(f_hat, ARM.acceleration(x[:2], x[2:], np.zeros(2)), atol=0.05)


@pytest.mark.parametrize(("max_age", "forgets"), [(None, False), (2.0, True)])
def test_only_a_record_that_grows_old_follows_a_robot_that_changes(
    make_scenario, two_link, max_age, forgets
):
    """The second mass goes from 2.3 to 3.5 kg after 5 s."""
    error, state = 0.0, None
    for mass in (2.3, 3.5):
        controller = {"kind": "concurrent_learning", "max_age": max_age}
        scenario = make_scenario(controller, plant={"masses": [1.0, mass]}, reference=MOVING)
        simulation = Simulation(scenario, two_link)
        if state:
            simulation.controller.restore(state)
        for _ in drive(simulation, 5.0):
            pass
        state = simulation.controller.state()
        truth = parameters(TwoLink((1.0, mass), (1.0, 1.0)))
        error = float(np.abs(law(simulation).theta - truth).max())
        assert mass != 2.3 or error < 0.1
    assert (error < 0.1) == forgets


@pytest.mark.parametrize("links", LINKS)
def test_each_recorded_pair_is_true_of_the_arm(make_scenario, two_link, links):
    scenario = make_scenario({"kind": "concurrent_learning"}, plant={"links": links})
    simulation = Simulation(scenario, two_link)
    for _ in drive(simulation, 2.5):
        pass
    parts = simulation.controller._parts
    phi = parameters(TwoLink((1.0, 2.3), (1.0, 1.0), 9.81, links)) / parts.window.scale
    assert (parts.stack.age < stacks.EMPTY).all()
    assert np.abs(parts.stack.U).max() > 1.0
    assert np.abs(parts.stack.Y @ phi - parts.stack.U).max() < 1e-4


def offered(n_pairs: int, rank: int, size: int = 6, oldest: int = stacks.EMPTY):
    """A stack that was shown pairs of p = 4 parameters, all within a space of `rank`."""
    rng = np.random.default_rng(3)
    phi = np.array([1.0, -2.0, 0.5, 3.0])
    stack = stacks.build_stack((size, 2, 4), 0.05, oldest)
    basis = rng.normal(size=(rank, 4))
    qualities = []
    for _ in range(n_pairs):
        Y = rng.normal(size=(2, rank)) @ basis
        stacks.offer(stack, Y, Y @ phi)
        qualities.append(stack.quality[0])
    return stack, phi, np.array(qualities)


def test_the_smallest_eigenvalue_is_that_of_numpy():
    stack, _, _ = offered(6, 4)
    expected = np.linalg.eigvalsh(np.einsum("kei,kej->ij", stack.Y, stack.Y))[0]
    assert stack.quality[0] == pytest.approx(expected, rel=1e-9)


def test_a_full_stack_only_gets_richer():
    stack, _, qualities = offered(200, 4)
    assert (np.diff(qualities[6:]) >= 0).all()
    assert qualities[-1] > 2 * qualities[6]
    assert stack.quality[0] == qualities[-1]


def test_a_stack_full_of_what_tells_little_still_takes_what_tells_more():
    stack, phi, qualities = offered(20, 2)
    assert not qualities.any()
    rng = np.random.default_rng(0)
    for _ in range(6):
        Y = rng.normal(size=(2, 4))
        stacks.offer(stack, Y, Y @ phi)
    assert stack.quality[0] > 0.0


def test_a_pair_makes_way_at_its_age():
    stack, _, _ = offered(200, 4, oldest=8)
    assert stack.age.max() <= 8 + stack.age.size
    kept, _, _ = offered(200, 4)
    assert kept.age.max() > 50


def test_learning_is_the_implicit_euler_step():
    stack, truth, _ = offered(6, 4)
    phi = np.zeros(4)
    expected = np.linalg.solve(np.eye(4) + 0.05 * stack.S, phi + 0.05 * stack.b)
    stacks.learn(stack, phi)
    assert np.allclose(phi, expected, rtol=1e-12)
    for _ in range(5000):
        stacks.learn(stack, phi)
    assert np.allclose(phi, truth, rtol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_frozen_estimates_and_records_stay(make_scenario, two_link, kind):
    simulation = Simulation(make_scenario({"kind": kind}), two_link)
    inputs = Inputs.zeros(2)
    inputs.x_ref[:] = 1.0
    for _ in range(150):
        simulation.controller.update(inputs)
    before = simulation.controller.state()
    inputs.frozen[0] = 1
    for _ in range(150):
        tau = simulation.controller.update(inputs).tau.copy()
    after = simulation.controller.state()
    for name in before:
        assert name == "window_periods" or np.array_equal(before[name], after[name]), name
    inputs.frozen[0] = 0
    simulation.controller.update(inputs)
    assert not np.array_equal(simulation.controller.state()["theta"], before["theta"])
    assert tau.any()


@pytest.mark.parametrize("kind", KINDS)
def test_interpreted_and_compiled_loop_give_the_same_run(make_scenario, two_link, kind):
    scenario = make_scenario({"kind": kind}, duration=1.0)
    simulation = Simulation(scenario, two_link)
    simulation.controller = Wrapped(simulation.controller)
    recorder = MemoryRecorder(simulation.layout, scenario.n_ticks)
    interpreted = recorder.trace(scenario, simulation.run(recorder))
    compiled = simulate(scenario, two_link)
    for name in set(compiled) - CLOCKED:
        assert np.array_equal(interpreted[name], compiled[name]), name


@pytest.mark.parametrize("kind", KINDS)
def test_a_restored_controller_goes_on_bit_for_bit(make_scenario, two_link, kind):
    runs = [Simulation(make_scenario({"kind": kind}), two_link) for _ in range(2)]
    for _ in drive(runs[0], 2.55):
        pass
    state = runs[0].controller.state()
    runs[1].controller.restore(state)
    inputs = Inputs.zeros(2)
    rng = np.random.default_rng(1)
    for _ in range(300):
        inputs.x[:], inputs.x_ref[:] = rng.normal(size=(2, 4))
        taus = [run.controller.update(inputs).tau.copy() for run in runs]
        assert np.array_equal(*taus)
    assert not np.array_equal(state["theta"], runs[1].controller.state()["theta"])


def test_leakage_pulls_the_estimates_down(make_scenario, two_link):
    norms = []
    for sigma in (0.0, 0.01):
        controller = {"kind": "slotine_li", "sigma": sigma}
        simulation = Simulation(make_scenario(controller, reference=REST), two_link)
        for _ in drive(simulation, 3.0):
            pass
        norms.append(np.linalg.norm(law(simulation).theta))
    assert norms[1] < 0.9 * norms[0]


@pytest.mark.parametrize("kind", KINDS)
def test_another_robot_is_refused_by_name(make_scenario, two_link, kind):
    bent = two_link.text.replace('pos="1 0 0" mass="2.3"', 'pos="1 0 0.2" mass="2.3"')
    assert bent != two_link.text
    scenario = make_scenario({"kind": kind}, plant={"model": "bent.xml"})
    with pytest.raises(
        ScenarioError, match=f"controller.kind = {kind}: its regressor does not fit this arm"
    ):
        Simulation(scenario, Mjcf(bent))


def test_a_robot_of_one_joint_is_refused(make_scenario, two_link):
    head, rest = two_link.text.split('<body name="link2"')
    text = head + rest.split("</body>", 1)[1]
    for name in ("motor2", "q2", "qd2"):
        text = "\n".join(line for line in text.splitlines() if f'name="{name}"' not in line)
    scenario = make_scenario(
        {"kind": "slotine_li"},
        plant={"model": "one.xml"},
        initial={"q": [0.0]},
        reference={"kind": "sinusoid"},
    )
    with pytest.raises(ScenarioError, match="does not fit a robot of 1 joint;"):
        Simulation(scenario, Mjcf(text))


def test_gains_of_wrong_length_are_refused(make_scenario):
    with pytest.raises(ValidationError, match="Gamma has 2 entries; allowed: 1 or 7"):
        make_scenario({"kind": "slotine_li", "Gamma": [1.0, 2.0]})
    with pytest.raises(ValidationError, match="K_D has 3 entries; allowed: 1 or 2"):
        make_scenario({"kind": "slotine_li", "K_D": [1.0, 2.0, 3.0]})
