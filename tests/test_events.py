"""Payloads and pushes: against arms built with them, and against impulse and Jacobian."""

from __future__ import annotations

import warnings

import mujoco
import numpy as np
import pytest

from dnnmso_mj.dynamics import TwoLink
from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.imperfections.tip import Tip
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.plant import Mjcf, Plant
from dnnmso_mj.simulation import Simulation, simulate

RNG = np.random.default_rng(0)
STATES = RNG.normal(size=(50, 2, 2))
OFF = {"kind": "no_network"}


def dynamics(model: mujoco.MjModel, q, qd) -> tuple[np.ndarray, np.ndarray]:
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q, qd
    mujoco.mj_forward(model, data)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    return M, data.qfrc_bias.copy()


def assert_alike(one: mujoco.MjModel, other: mujoco.MjModel) -> None:
    for q, qd in STATES:
        for a, b in zip(dynamics(one, q, qd), dynamics(other, q, qd), strict=True):
            assert np.allclose(a, b, rtol=0, atol=1e-12 * np.abs(b).max())


@pytest.mark.parametrize("payload", [1.2, -1.0])
def test_an_arm_with_a_payload_is_the_arm_built_with_it(make_scenario, two_link, payload):
    plant = Plant(make_scenario(), two_link)
    Tip(plant.model, "two_link").carry(payload)
    other = make_scenario(plant={"masses": [1.0, 2.3 + payload]})
    assert_alike(plant.model, Plant(other, two_link).model)


def test_a_payload_on_a_rod_follows_steiners_theorem(make_scenario, two_link):
    """The same mass as a body of its own, fixed at the tip, is the other way to have it."""
    rods = make_scenario(plant={"links": "rod", "masses": [1.0, 2.0], "lengths": [0.7, 0.4]})
    plant = Plant(rods, two_link)
    spec = mujoco.MjSpec.from_string(two_link.text)
    for k, (mass, length) in enumerate([(1.0, 0.7), (2.0, 0.4)], start=1):
        body = spec.body(f"link{k}")
        body.mass, body.ipos = mass, [length / 2, 0, 0]
        body.inertia = [1e-14, *[mass * length**2 / 12] * 2]
    spec.body("link2").pos = [0.7, 0, 0]
    weight = spec.body("link2").add_body(name="weight", pos=[0.4, 0, 0])
    weight.mass, weight.ipos, weight.inertia = 1.5, [0, 0, 0], [1e-14] * 3
    weight.explicitinertial = 1
    Tip(plant.model, "two_link").carry(1.5)
    assert_alike(plant.model, spec.compile())


@pytest.mark.parametrize(
    "inertial", ['pos=".2 .1 0" euler="20 0 10"', 'pos="0 0 0"', 'pos=".1 0 0"']
)
def test_a_payload_off_the_axis_turns_the_inertia(make_scenario, inertial):
    """An arm of its own, in three dimensions, whose tip is on no axis of its last link."""
    text = f"""<mujoco><worldbody><body name="a"><joint name="j1" axis="0 0 1"/>
      <inertial pos=".1 .2 .3" mass="2" diaginertia=".1 .2 .25"/>
      <body name="b" pos=".5 0 .1" euler="10 20 30"><joint name="j2" axis="0 1 0"/>
      <inertial {inertial} mass="1" diaginertia=".1 .1 .15"/>
      <site name="tip" pos=".4 .1 -.2"/><site name="mark" pos=".1 0 0"/>{{}}</body></body>
      </worldbody><actuator><motor joint="j1"/><motor joint="j2"/></actuator></mujoco>"""
    weight = """<body pos=".4 .1 -.2">
      <inertial pos="0 0 0" mass=".7" diaginertia="1e-14 1e-14 1e-14"/></body>"""
    plant = Plant(make_scenario(plant={"model": "own"}), Mjcf(text.format("")))
    tip = Tip(plant.model, "own")
    tip.carry(0.7)
    built = mujoco.MjModel.from_xml_string(text.format(weight))
    assert_alike(plant.model, built)
    assert np.allclose(*(places(model) for model in (plant.model, built)), rtol=0, atol=1e-12)
    before = Plant(make_scenario(plant={"model": "own"}), Mjcf(text.format("")))
    tip.carry(0.0)
    for name in ("body_inertia", "body_ipos", "body_sameframe", "site_sameframe", "dof_invweight0"):
        assert np.array_equal(getattr(plant.model, name), getattr(before.model, name)), name


def places(model: mujoco.MjModel) -> np.ndarray:
    """Where the sites of a model are in a bent pose."""
    data = mujoco.MjData(model)
    data.qpos[:] = STATES[0, 0]
    mujoco.mj_forward(model, data)
    return data.site_xpos


def test_a_payload_comes_at_its_time_and_a_run_begins_without_it(make_scenario, two_link):
    events = [
        {"kind": "payload", "at": 0.3, "mass": 1.2},
        {"kind": "payload", "at": 0.6, "mass": -1.2},
    ]
    scenario = make_scenario(OFF, duration=0.9, events=events)
    simulation = Simulation(scenario, two_link)
    recorder = MemoryRecorder(simulation.layout, scenario.n_ticks)
    trace = recorder.trace(scenario, simulation.run(recorder))
    for k, mass in ((0, 2.3), (299, 2.3), (300, 3.5), (599, 3.5), (600, 2.3)):
        plant = Plant(make_scenario(plant={"masses": [1.0, mass]}), two_link)
        plant.reset(trace["q"][k], trace["qd"][k])
        plant.step(trace["tau"][k])
        assert np.allclose(plant.q, trace["q"][k + 1], rtol=0, atol=1e-12), k
        assert np.allclose(plant.qd, trace["qd"][k + 1], rtol=0, atol=1e-11), k
    assert [event.message for event in trace.events] == [
        "1.2 kg taken up at the tip: link2 has 3.5 kg",
        "1.2 kg dropped at the tip: link2 has 2.3 kg",
    ]
    assert [event.t for event in trace.events] == pytest.approx([0.3, 0.6])
    again = MemoryRecorder(simulation.layout, scenario.n_ticks)
    second = again.trace(scenario, simulation.run(again))
    assert np.array_equal(trace["q"], second["q"])
    assert Plant(make_scenario(), two_link).model.body_mass[2] == 2.3


def test_an_arm_of_one_joint_takes_a_payload(make_scenario):
    text = """<mujoco><worldbody><body name="link1"><joint name="j" axis="0 -1 0"/>
      <inertial pos="1 0 0" mass="1" diaginertia="1e-3 1e-3 1e-3"/></body></worldbody>
      <actuator><motor joint="j"/></actuator></mujoco>"""
    one = {"initial": {"q": [0.0]}, "reference": {"kind": "sinusoid"}}
    light, heavy = (
        Plant(make_scenario(plant={"masses": [m], "lengths": [0.5]}, **one), Mjcf(text)).model
        for m in (1.0, 1.6)
    )
    Tip(light, "one").carry(0.6)
    for a, b in zip(dynamics(light, 0.3, 1.0), dynamics(heavy, 0.3, 1.0), strict=True):
        assert np.allclose(a, b, rtol=1e-12)


def test_a_push_on_the_joints_adds_its_torque_for_its_time(make_scenario, two_link):
    push = {"kind": "push", "at": 0.1, "duration": 0.05, "torque": [10.0, -4.0]}
    trace = simulate(make_scenario(OFF, duration=0.3, events=[push]))
    plant = Plant(make_scenario(), two_link)
    for k, extra in ((99, 0), (100, 1), (149, 1), (150, 0)):
        plant.reset(trace["q"][k], trace["qd"][k])
        plant.step(trace["tau"][k] + extra * np.array([10.0, -4.0]))
        assert np.allclose(plant.qd, trace["qd"][k + 1], rtol=0, atol=1e-12), k
    assert [e.message for e in trace.events] == [
        "a push begins: [10, -4] N·m on the joints",
        "a push ends: [10, -4] N·m on the joints",
    ]


def test_a_push_on_the_tip_does_what_the_jacobian_says(make_scenario, two_link):
    force = [3.0, -5.0]
    push = {"kind": "push", "at": 0.1, "duration": 0.05, "force": force}
    trace = simulate(make_scenario(OFF, duration=0.3, events=[push]))
    plant = Plant(make_scenario(), two_link)
    for k, extra in ((99, 0), (100, 1), (149, 1), (150, 0)):
        q1, q12 = trace["q"][k, 0], trace["q"][k].sum()
        J = np.array(
            [[-np.sin(q1) - np.sin(q12), -np.sin(q12)], [np.cos(q1) + np.cos(q12), np.cos(q12)]]
        )
        plant.reset(trace["q"][k], trace["qd"][k])
        plant.step(trace["tau"][k] + extra * J.T @ force)
        assert np.allclose(plant.qd, trace["qd"][k + 1], rtol=0, atol=1e-12), k


def test_the_impulse_of_a_push_is_torque_times_time(make_scenario):
    """Joint space momentum of an arm without gravity, at rest but for the push, undriven."""
    free = {"kind": "no_network", "inversion": {"K": 1e-9, "lam": 1e-9}, "kinematics": False}
    still = {"kind": "setpoint", "start": [0.5, 0.5], "goal": [0.5, 0.5], "blend_time": 0.1}
    events = [
        {"kind": "push", "at": 0.0, "duration": 0.004, "torque": [0.0, 5.0]},
        {"kind": "push", "at": 0.002, "duration": 0.004, "torque": [0.0, 5.0]},
    ]
    trace = simulate(
        make_scenario(free, duration=0.02, reference=still, plant={"gravity": 0.0}, events=events)
    )
    M = TwoLink((1.0, 2.3), (1.0, 1.0)).inertia(trace["q"][-1])
    assert np.allclose(M @ trace["qd"][-1], [0.0, 0.04], rtol=1e-2, atol=1e-4)


@pytest.mark.parametrize(
    "events",
    [
        [{"kind": "push", "at": 1.0, "duration": 0.1, "torque": 20.0}],
        [{"kind": "payload", "at": 1.0, "mass": 1.2}, {"kind": "payload", "at": 2.0, "mass": -1.2}],
    ],
)
@pytest.mark.parametrize("kind", ["no_network", "dnn_mso"])
def test_the_bound_of_the_closed_loop_holds_through_events(make_scenario, kind, events):
    trace = simulate(make_scenario({"kind": kind}, duration=3.0, events=events))
    assert compute_metrics(trace)["bound_violations"] == 0


def test_the_bound_counts_a_push_as_what_was_held_through_the_step(make_scenario):
    """The comparison equations of `theory`, integrated anew from the log and the push."""
    torque = np.array([200.0, -100.0])
    push = {"kind": "push", "at": 0.02, "duration": 0.01, "torque": torque.tolist()}
    trace = simulate(make_scenario(OFF, duration=0.05, events=[push]))
    gain = lam = 7.5
    arm = TwoLink((1.0, 2.3), (1.0, 1.0))
    e, ed = trace["q"] - trace["q_ref"], trace["qd"] - trace["qd_ref"]
    qdd_ref = [[-0.25 * np.sin(0.5 * t), -0.25 * np.cos(0.5 * t)] for t in trace["t"]]

    def d(k: int, held: int) -> float:
        """‖d‖ at tick k under what is held through the step that begins at tick `held`."""
        tau = trace["tau"][held] + torque * (20 <= held < 30)
        edd = arm.acceleration(trace["q"][k], trace["qd"][k], tau) - qdd_ref[k]
        return float(np.linalg.norm(edd + (gain + lam) * ed[k] + gain * lam * e[k]))

    decay, weight = np.exp(-7.5e-3), -np.expm1(-7.5e-3) / 7.5
    s, joint = np.linalg.norm(ed[0] + lam * e[0]), np.linalg.norm(e[0])
    for k in range(len(trace) - 1):
        before, s = s, decay * s + weight * 0.5 * (d(k, k) + d(k + 1, k))
        joint = decay * joint + weight * max(s, before)
        assert trace["ultimate_bound"][k + 1] == pytest.approx(joint, rel=1e-9), k


def event(**parts) -> dict:
    return {"events": [parts]}


PUSH = {"kind": "push", "at": 1.0, "duration": 0.1}


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (event(kind="payload", at=1.0, mass=0.0), "changes nothing"),
        (event(kind="payload", at=10.0, mass=1.0), "events.0.at is at the end or after it"),
        (event(**PUSH), "allowed: one of them"),
        (event(**PUSH, torque=[1.0, 1.0, 1.0]), "events.0.torque has 3 entries"),
        (event(**PUSH, force=[1.0]), "at least 2"),
        (event(**PUSH | {"duration": 1e-4}, torque=1.0), "events.0.duration is less than one step"),
        ({"imperfections": {"torque_rate": [1.0] * 3}}, "torque_rate has 3 entries"),
        ({"imperfections": {"position_bias": [1.0] * 3}}, "position_bias has 3 entries"),
        ({"imperfections": {"friction": {"coulomb": [1.0] * 3}}}, "friction.coulomb has 3 entries"),
    ],
)
def test_impossible_events_are_refused(make_scenario, parts, message):
    with pytest.raises(ValueError, match=message):
        make_scenario(**parts)


def test_a_payload_cannot_take_more_than_the_link_has(make_scenario, two_link):
    drop = make_scenario(**event(kind="payload", at=1.0, mass=-2.3))
    with pytest.raises(ScenarioError, match=r"events\.0\.mass = -2\.3.*allowed: above -2\.3 kg"):
        Simulation(drop, two_link)
    rod = make_scenario(**event(kind="payload", at=1.0, mass=-2.0), plant={"links": "rod"})
    with pytest.raises(ScenarioError, match="negative moment of inertia"):
        Simulation(rod, two_link)


def test_an_own_model_without_a_tip_is_told_to_name_one(make_scenario):
    text = """<mujoco><worldbody><body><joint name="j" axis="0 -1 0"/>
      <inertial pos="1 0 0" mass="1" diaginertia="1e-3 1e-3 1e-3"/></body></worldbody>
      <actuator><motor joint="j"/></actuator></mujoco>"""
    parts = {"initial": {"q": [0.0]}, "reference": {"kind": "sinusoid"}, "plant": {"model": "own"}}
    scenario = make_scenario(OFF, **parts, **event(kind="payload", at=1.0, mass=1.0))
    with pytest.raises(ScenarioError, match='<site name="tip">'):
        Simulation(scenario, Mjcf(text))


@pytest.mark.parametrize(
    ("override", "warned"),
    [
        ("imperfections.torque_limit=70", "78.48 N·m of the arm with 1.2 kg at its tip"),
        ("imperfections.torque_limit=80", None),
        ("imperfections.friction.coulomb=[1.0,120.0]", "joint 2 is held by 120 N·m"),
        ("imperfections.friction.coulomb=[1.0,119.0]", None),
    ],
)
def test_loads_beyond_the_torque_limit_are_warned_of(override, warned):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load_scenario("hard", [override])
    assert [warned in str(warning.message) for warning in caught] == ([True] if warned else [])


def test_the_shipped_scenarios_are_as_hard_as_they_say():
    hard, late = load_scenario("hard"), load_scenario("hard_delay")
    assert (hard.imperfections.position_noise, hard.imperfections.velocity_noise) == (
        (1e-4,),
        (1e-3,),
    )
    assert hard.imperfections.torque_limit == (120.0,)
    assert [(e.kind, e.at, e.mass) for e in hard.events] == [("payload", 20.0, 1.2)]
    assert late.imperfections.actuator_delay == 0.02
    assert late.controller.known_delay.actuator == 0.02
    rest = {"name", "description", "imperfections", "controller"}
    assert hard.model_dump(exclude=rest) == late.model_dump(exclude=rest)
    known = {"known_delay"}
    assert hard.controller.model_dump(exclude=known) == late.controller.model_dump(exclude=known)


@pytest.mark.parametrize(("name", "worst"), [("push", 1e-2), ("friction", 1e-2)])
def test_the_papers_controller_survives_and_beats_no_network(name, worst):
    on = compute_metrics(simulate(load_scenario(name)))
    off = compute_metrics(simulate(load_scenario(name, ["controller.kind=no_network"])))
    assert on["rmse_steady"] < worst
    assert on["rmse_steady"] < 0.25 * off["rmse_steady"]
    assert on["bound_violations"] == off["bound_violations"] == 0
