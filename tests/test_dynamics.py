"""The analytic dynamics against MuJoCo, Pinocchio and the invariants of mechanics."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pinocchio
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from dnnmso_mj.check import TOLERANCE, check_dynamics
from dnnmso_mj.dynamics import LINKS, Links, TwoLink
from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.plant import Mjcf

arms = st.builds(
    TwoLink,
    masses=st.tuples(st.floats(0.1, 10), st.floats(0.1, 10)),
    lengths=st.tuples(st.floats(0.2, 2), st.floats(0.2, 2)),
    gravity=st.floats(0, 20),
    links=st.sampled_from(LINKS),
)
angles = st.tuples(st.floats(-4, 4), st.floats(-4, 4)).map(np.array)
velocities = st.tuples(st.floats(-9, 9), st.floats(-9, 9)).map(np.array)


@pytest.mark.parametrize("links", LINKS)
def test_mujoco_agrees_with_the_formula_over_ten_thousand_states(two_link, links):
    result = check_dynamics(two_link, links, n_states=10_000, seed=1)
    assert result.n_arms == 100
    assert result.passed
    assert max(result.errors.values()) <= TOLERANCE == 1e-10


def test_check_sees_an_armature_of_one_millionth(two_link):
    geared = Mjcf(two_link.text.replace('armature="0"', 'armature="1e-6"'))
    assert geared != two_link
    result = check_dynamics(geared, "rod", n_states=200)
    assert not result.passed
    assert result.errors["M"] > TOLERANCE >= result.errors["G"]


def test_check_sees_an_axis_turned_the_other_way(two_link):
    turned = Mjcf(two_link.text.replace('axis="0 -1 0"', 'axis="0 1 0"'))
    result = check_dynamics(turned, "point_mass", n_states=200)
    assert result.errors["G"] > 0.1


def test_check_refuses_an_arm_that_has_not_two_links(two_link):
    extra = '<site name="tip"', '<body name="hand"><geom size="0.1"/></body><site name="tip"'
    message = "plant.model = mine.xml: 3 bodies and 2 joints; allowed: 2 and 2"
    with pytest.raises(ScenarioError, match=message):
        check_dynamics(Mjcf(two_link.text.replace(*extra)), "rod", n_states=1, name="mine.xml")


def pinocchio_arm(arm: TwoLink) -> tuple[pinocchio.Model, pinocchio.Data]:
    model = pinocchio.Model()
    model.gravity.linear = np.array([0.0, 0.0, -arm.gravity])
    parent, place = 0, pinocchio.SE3.Identity()
    for k, (mass, length) in enumerate(zip(arm.masses, arm.lengths, strict=True)):
        axis = pinocchio.JointModelRevoluteUnaligned(np.array([0.0, -1.0, 0.0]))
        parent = model.addJoint(parent, axis, place, f"joint{k}")
        point = arm.links == "point_mass"
        centre, about = (length, 0.0) if point else (length / 2, mass * length**2 / 12)
        inertia = pinocchio.Inertia(mass, np.array([centre, 0, 0]), np.diag([0, about, about]))
        model.appendBodyToJoint(parent, inertia, pinocchio.SE3.Identity())
        place = pinocchio.SE3(np.eye(3), np.array([length, 0.0, 0.0]))
    return model, model.createData()


@given(arms, angles, velocities, velocities)
def test_pinocchio_agrees_as_third_opinion(arm, q, qd, tau):
    model, data = pinocchio_arm(arm)
    M = pinocchio.crba(model, data, q)
    G = pinocchio.computeGeneralizedGravity(model, data, q).copy()
    V = pinocchio.nonLinearEffects(model, data, q, qd) - G
    scale = 1 + np.abs(M).max() * (1 + qd @ qd + arm.gravity)
    assert np.allclose(np.triu(M), np.triu(arm.inertia(q)), rtol=0, atol=1e-12 * scale)
    assert np.allclose(G, arm.gravity_torque(q), rtol=0, atol=1e-12 * scale)
    assert np.allclose(V, arm.coriolis(q, qd), rtol=0, atol=1e-12 * scale)
    qdd = pinocchio.aba(model, data, q, qd, tau)
    residual = arm.inertia(q) @ qdd + V + G - tau
    assert np.abs(residual).max() <= 1e-9 * scale


@given(arms, angles, velocities)
def test_inertia_rate_minus_twice_coriolis_is_skew(arm, q, qd):
    h = 1e-6
    M_dot = (arm.inertia(q + h * qd) - arm.inertia(q - h * qd)) / (2 * h)
    N = M_dot - 2 * arm.coriolis_matrix(q, qd)
    scale = 1 + np.abs(arm.inertia(q)).max() * (1 + np.abs(qd).max()) ** 3
    assert np.abs(N + N.T).max() <= 1e-7 * scale


@given(arms, angles, velocities)
def test_coriolis_vector_is_the_matrix_times_velocity(arm, q, qd):
    assert np.allclose(arm.coriolis(q, qd), arm.coriolis_matrix(q, qd) @ qd, atol=1e-9)


@given(arms, angles)
def test_gravity_torque_is_the_slope_of_the_energy(arm, q):
    h, rest = 1e-6, np.zeros(2)
    slope = [
        (arm.energy(q + h * e, rest) - arm.energy(q - h * e, rest)) / (2 * h) for e in np.eye(2)
    ]
    assert np.allclose(slope, arm.gravity_torque(q), atol=1e-6)


@given(arms, angles)
def test_inertia_is_symmetric_and_positive_definite(arm, q):
    M = arm.inertia(q)
    assert np.array_equal(M, M.T)
    assert np.linalg.eigvalsh(M)[0] > 0


@pytest.mark.parametrize("links", LINKS)
def test_free_fall_conserves_energy(links):
    arm = TwoLink((1.0, 2.3), (1.0, 0.7), 9.81, links)

    def rate(_, x):
        return np.concatenate([x[2:], arm.acceleration(x[:2], x[2:], np.zeros(2))])

    run = solve_ivp(rate, (0, 5), [0.5, 0.5, 0.0, 1.0], rtol=1e-11, atol=1e-12)
    energy = arm.energy(run.y[:2].T, run.y[2:].T)
    assert np.ptp(energy) < 1e-7
    assert np.ptp(run.y[0]) > 1.0  # it did move


def test_one_link_of_negligible_second_mass_is_a_pendulum():
    arm = TwoLink((2.0, 1e-12), (0.5, 1e-3), 9.81, "rod")
    q, qd, tau = np.array([0.3, 0.0]), np.zeros(2), np.array([1.0, 0.0])
    M11, G1 = 2.0 * 0.5**2 / 3, 2.0 * 9.81 * 0.25 * np.cos(0.3)
    assert arm.inertia(q)[0, 0] == pytest.approx(M11)
    assert arm.gravity_torque(q)[0] == pytest.approx(G1)
    assert arm.acceleration(q, qd, tau)[0] == pytest.approx((1.0 - G1) / M11, rel=1e-6)


def test_an_arm_has_point_masses_or_rods():
    assert get_args(Links) == LINKS == ("point_mass", "rod")
    assert TwoLink((1.0, 2.0), (1.0, 1.0)) == TwoLink((1.0, 2.0), (1.0, 1.0), 9.81, "point_mass")


@pytest.mark.parametrize("links", LINKS)
def test_many_states_at_once_are_as_one_after_the_other(links):
    arm, rng = TwoLink((1.0, 2.3), (1.1, 0.7), 9.81, links), np.random.default_rng(0)
    q, qd, tau = rng.normal(size=(3, 4, 5, 2))
    for method, states in (
        (arm.inertia, (q,)),
        (arm.coriolis_matrix, (q, qd)),
        (arm.coriolis, (q, qd)),
        (arm.gravity_torque, (q,)),
        (arm.acceleration, (q, qd, tau)),
        (arm.energy, (q, qd)),
    ):
        together = method(*states)
        for index in np.ndindex(4, 5):
            alone = method(*(values[index] for values in states))
            np.testing.assert_allclose(together[index], alone, rtol=1e-13, atol=1e-14)


def test_an_arm_at_rest_along_the_horizontal_has_no_energy():
    arm = TwoLink((1.0, 2.3), (1.1, 0.7))
    assert arm.energy(np.zeros(2), np.zeros(2)) == 0.0
    moving = arm.energy(np.zeros(2), np.array([2.0, 0.0]))
    assert moving == pytest.approx(0.5 * (1.0 * 2.2**2 + 2.3 * 3.6**2))  # ½ m v² of both masses


def test_holding_the_papers_arm_stretched_out_takes_54_9_newton_metres():
    arm = TwoLink((1.0, 2.3), (1.0, 1.0))
    assert arm.gravity_torque(np.zeros(2))[0] == pytest.approx((1 + 2 * 2.3) * 9.81)
