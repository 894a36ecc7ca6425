"""Friction: closed forms, stiction that holds, and no energy out of nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dnnmso_mj.dynamics import TwoLink
from dnnmso_mj.imperfections.friction import friction_law
from dnnmso_mj.imperfections.loads import build_loads, load, start_loads
from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.plant import Mjcf, Plant, integrate
from dnnmso_mj.scenario import Friction
from dnnmso_mj.simulation import Simulation, simulate
from dnnmso_mj.tick import MUJOCO_ZEROES_ABOVE

DT = 1e-3
INTEGRATORS = ["rk4", "euler", "implicitfast"]


class Coasting:
    """An arm with friction, without a controller."""

    def __init__(self, make_scenario, mjcf, friction: dict[str, Any], **plant: Any) -> None:
        self.scenario = make_scenario(plant=plant, imperfections={"friction": friction})
        self.plant = Plant(self.scenario, mjcf)
        self.loads = build_loads(self.scenario, self.plant, None)

    def run(self, q, qd, n_ticks: int, tau=(0.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
        """Angles and velocities (N, n) at each tick."""
        self.plant.reset(q, qd)
        start_loads(self.loads)
        q, qd = np.zeros((2, n_ticks, 2))
        for k in range(n_ticks):
            q[k], qd[k] = self.plant.q, self.plant.qd
            load(self.loads, self.plant.view, np.array(tau), DT, MUJOCO_ZEROES_ABOVE)
            integrate(self.plant.view)
        return q, qd

    def energy(self, q, qd) -> float:
        """Kinetic energy (J)."""
        M = TwoLink((1.0, 2.3), (1.0, 1.0)).inertia(q)
        return 0.5 * np.einsum("ki,kij,kj->k", qd, M, qd)


@pytest.fixture(params=INTEGRATORS)
def integrator(request) -> str:
    return request.param


def test_the_law_of_one_joint_is_stribecks_curve(make_scenario, two_link):
    """The first joint turns alone: the second is held by friction it cannot break."""
    law = {"coulomb": [2.0, 1e3], "breakaway": [5.0, 1e3], "stribeck_velocity": 0.5}
    arm = Coasting(make_scenario, two_link, law, gravity=0.0)
    for qd in (0.1, 0.5, 3.0):
        arm.run([0.0, 0.3], [qd, 0.0], 1)
        assert arm.loads.torque[0] == pytest.approx(-(2.0 + 3.0 * np.exp(-((qd / 0.5) ** 2))))


def test_coulomb_friction_stops_an_arm_when_and_where_it_must(make_scenario, two_link, integrator):
    """I q̈ = −F: it stops after I q̇₀/F, I q̇₀²/(2F) further on, and stays."""
    friction = {"coulomb": [4.0, 1e3]}
    arm = Coasting(make_scenario, two_link, friction, gravity=0.0, integrator=integrator)
    inertia = 1.0 + 2.3 * 4.0
    q, qd = arm.run([0.0, 0.0], [1.0, 0.0], 4000)
    stop = inertia * 1.0 / 4.0
    moving = qd[:, 0] > 1e-9
    assert moving.sum() * DT == pytest.approx(stop, abs=2 * DT)
    assert q[-1, 0] == pytest.approx(inertia / 8.0, abs=2 * DT)
    assert np.abs(qd[3000:]).max() < 1e-9
    assert np.ptp(q[3000:], axis=0).max() < 1e-9


def test_a_load_below_breakaway_is_held_and_one_above_is_not(make_scenario, two_link, integrator):
    """Held without creep: gravity pulls for seconds, and the arm stays to the last digits."""
    friction = {"coulomb": 20.0, "breakaway": [56.0, 24.0]}
    arm = Coasting(make_scenario, two_link, friction, integrator=integrator)
    q, _ = arm.run([0.0, 0.0], [0.0, 0.0], 3000)  # the load is 54.9 and 22.6 N·m
    assert np.abs(q).max() < 1e-12
    q, _ = arm.run([0.0, 0.0], [0.0, 0.0], 100, tau=(-2.0, 0.0))
    assert q[-1, 0] < -1e-3


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_friction_is_full_against_motion_or_less_at_rest(make_scenario, n):
    """The law at the end of the period, for chains whose joints pull at one another."""
    body = "".join(
        f'<body name="link{k}" pos="{float(k > 1)} 0 0"><joint name="j{k}" axis="0 -1 0"/>'
        '<inertial pos="1 0 0" mass="1" diaginertia="1e-3 1e-3 1e-3"/>'
        for k in range(1, n + 1)
    )
    motors = "".join(f'<motor joint="j{k}"/>' for k in range(1, n + 1))
    mjcf = Mjcf(f"<mujoco><worldbody>{body}{'</body>' * n}</worldbody>"
                f"<actuator>{motors}</actuator></mujoco>")  # fmt: skip
    rng, most = np.random.default_rng(n), 8.0
    scenario = make_scenario(
        plant={"masses": [0.5] * n, "lengths": [0.4] * n},
        initial={"q": [0.0] * n},
        reference={"kind": "sinusoid"},
        imperfections={"friction": {"coulomb": most}},
    )
    plant = Plant(scenario, mjcf)
    loads = build_loads(scenario, plant, None)
    held = 0
    for _ in range(50):
        plant.reset(rng.uniform(-1, 1, n), rng.normal(0.0, 0.02, n))
        start_loads(loads)
        load(loads, plant.view, rng.normal(0.0, 10.0, n), DT, MUJOCO_ZEROES_ABOVE)
        v = plant.qd + DT * plant.view.qacc
        free = np.abs(loads.torque) >= most
        assert np.abs(loads.torque).max() <= most
        assert np.abs(v[~free]).max(initial=0.0) < 1e-9
        assert np.all(loads.torque[free] * v[free] <= 1e-9)
        held += (~free).sum()
    assert 0 < held < 50 * n


@pytest.mark.parametrize("seed", range(5))
def test_friction_never_adds_energy_nor_turns_a_joint_round(
    make_scenario, two_link, integrator, seed
):
    rng = np.random.default_rng(seed)
    friction = {"coulomb": [3.0, 2.0], "breakaway": [6.0, 5.0], "stribeck_velocity": 0.05}
    arm = Coasting(make_scenario, two_link, friction, gravity=0.0, integrator=integrator)
    q, qd = arm.run(rng.uniform(-3, 3, 2), rng.uniform(-2, 2, 2), 12_000)
    energy = arm.energy(q, qd)
    slack = 1e-9 if integrator == "rk4" else 2e-5  # first order in dt without any friction, too
    assert np.diff(energy).max() < slack * energy[0]
    assert energy[-1] < 1e-12 * energy[0]


def test_the_sign_of_the_velocity_alone_would_chatter(make_scenario, two_link):
    """The negative control: −F sign q̇ held through a step never comes to rest."""
    arm = Coasting(make_scenario, two_link, {}, gravity=0.0)
    arm.plant.reset(np.zeros(2), np.array([0.1, 0.0]))
    turns, before = 0, arm.plant.qd.copy()
    for _ in range(2000):
        arm.plant.applied[:] = -np.array([3.0, 2.0]) * np.sign(arm.plant.qd)
        arm.plant.step(np.zeros(2))
        turns += int((arm.plant.qd * before < 0).any())
        before = arm.plant.qd.copy()
    assert turns > 500


def test_viscous_friction_slows_as_an_exponential(make_scenario, two_link):
    arm = Coasting(make_scenario, two_link, {"viscous": [3.0, 0.0], "coulomb": [0.0, 1e3]},
                   gravity=0.0)  # fmt: skip
    _, qd = arm.run([0.0, 0.0], [1.0, 0.0], 2000)
    t = np.arange(2000) * DT
    assert np.allclose(qd[:, 0], np.exp(-3.0 * t / (1.0 + 2.3 * 4.0)), atol=1e-9)


def test_friction_is_the_plants_alone(make_scenario, two_link):
    scenario = make_scenario(imperfections={"friction": {"viscous": 3.0}})
    simulation = Simulation(scenario, two_link)
    assert simulation.plant.model.dof_damping.tolist() == [3.0, 3.0]
    assert simulation.stage._nominal.model.dof_damping.tolist() == [0.0, 0.0]
    assert Simulation(make_scenario(), two_link).plant.model.dof_damping.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("friction", [{"viscous": 2.0}, {"coulomb": 3.0, "breakaway": 5.0}])
def test_the_true_dynamics_hold_the_friction(make_scenario, friction):
    scenario = make_scenario(
        {"kind": "no_network"}, duration=1.0, imperfections={"friction": friction}
    )
    trace = simulate(scenario)
    q, qd, arm = trace["q"], trace["qd"], TwoLink((1.0, 2.3), (1.0, 1.0))
    free = arm.acceleration(q, qd, np.zeros_like(q))
    tau = np.einsum("kij,kj->ki", arm.inertia(q), trace["f_true"][:, 2:] - free)
    if "viscous" in friction:
        assert np.allclose(tau, -2.0 * qd, atol=1e-8)
    else:
        fast = np.abs(qd) > 0.1
        assert np.allclose(tau[fast], -3.0 * np.sign(qd[fast]), atol=1e-8)
        assert np.abs(tau).max() <= 5.0 + 1e-8


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("kind", ["no_network", "dnn_mso"])
def test_the_bound_of_the_closed_loop_holds_with_friction(make_scenario, kind, integrator):
    friction = {"viscous": 1.0, "coulomb": 3.0, "breakaway": 5.0}
    scenario = make_scenario(
        {"kind": kind},
        duration=3.0,
        plant={"integrator": integrator},
        imperfections={"friction": friction},
    )
    assert compute_metrics(simulate(scenario))["bound_violations"] == 0


def test_breakaway_is_coulomb_where_it_is_not_given():
    assert friction_law(Friction(coulomb=[1.0, 2.0]), 2)[1].tolist() == [0.0, 0.0]
    assert friction_law(Friction(coulomb=1.0, breakaway=[1.0, 3.0]), 2)[1].tolist() == [0.0, 2.0]


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ({"coulomb": 2.0, "breakaway": 1.0}, "breakaway is below coulomb; allowed: 2 or more"),
        ({"coulomb": [1.0, 2.0], "breakaway": 1.5}, "allowed: 1, 2 or more"),
        ({"viscous": -1.0}, "viscous"),
        ({"stribeck_velocity": 0.0}, "stribeck_velocity"),
    ],
)
def test_impossible_friction_is_refused(spec, message):
    with pytest.raises(ValueError, match=message):
        Friction(**spec)
