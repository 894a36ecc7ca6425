"""The MuJoCo plant: energy, order of convergence, and what it refuses."""

from __future__ import annotations

import re

import mujoco
import numpy as np
import pytest
from dm_control import mujoco as dm_mujoco

from dnnmso_mj.dynamics import TwoLink
from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.plant import Mjcf, NominalModel, Plant


def fall(make_scenario, mjcf, integrator, dt, duration=1.0):
    """State and energy after a free fall from the paper's start."""
    scenario = make_scenario(plant={"integrator": integrator}, dt=dt, duration=duration)
    plant = Plant(scenario, mjcf)
    plant.reset(np.array([0.5, 0.5]), np.zeros(2))
    for _ in range(scenario.n_ticks):
        plant.step(np.zeros(2))
    arm = TwoLink((1.0, 2.3), (1.0, 1.0))
    return np.concatenate([plant.q, plant.qd]), float(arm.energy(plant.q, plant.qd))


def test_free_fall_at_1_khz_conserves_energy(make_scenario, two_link):
    start = float(TwoLink((1.0, 2.3), (1.0, 1.0)).energy(np.array([0.5, 0.5]), np.zeros(2)))
    _, end = fall(make_scenario, two_link, "rk4", 1e-3, duration=5.0)
    assert abs(end - start) < 1e-6 * abs(start)


@pytest.mark.parametrize(("integrator", "order"), [("rk4", 4), ("euler", 1)])
def test_integrator_converges_with_its_order(make_scenario, two_link, integrator, order):
    exact, _ = fall(make_scenario, two_link, "rk4", 1e-4)
    steps = np.array([0.008, 0.004, 0.002])
    errors = [
        np.linalg.norm(fall(make_scenario, two_link, integrator, dt)[0] - exact) for dt in steps
    ]
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(order, abs=0.2)


def test_masses_lengths_gravity_and_step_come_from_the_scenario(make_scenario, two_link):
    parts = {"masses": [0.4, 3.0], "lengths": [0.5, 1.5], "gravity": 1.6}
    scenario = make_scenario(plant=parts, dt=0.002)
    plant = Plant(scenario, two_link)
    arm = TwoLink((0.4, 3.0), (0.5, 1.5), 1.6)
    q, qd, tau = np.array([0.2, -0.7]), np.array([1.0, 2.0]), np.array([3.0, -1.0])
    plant.reset(q, qd)
    assert np.allclose(plant.acceleration(tau), arm.acceleration(q, qd, tau), rtol=1e-10)
    assert plant.model.opt.timestep == 0.002
    tip = plant.model.site("tip").pos
    assert tip.tolist() == [1.5, 0.0, 0.0]


def test_nominal_model_may_be_wrong_without_touching_the_plant(make_scenario, two_link):
    effectiveness = {"kind": "inertia", "masses": [0.8, 1.6]}
    controller = {"kind": "dnn_mso", "inversion": {"effectiveness": effectiveness}}
    scenario = make_scenario(controller)
    q = np.array([0.3, 0.9])
    believed = NominalModel(scenario, two_link).inertia(q)
    assert np.allclose(believed, TwoLink((0.8, 1.6), (1.0, 1.0)).inertia(q), rtol=1e-12)
    plant = Plant(scenario, two_link)
    plant.reset(q, np.zeros(2))
    true = TwoLink((1.0, 2.3), (1.0, 1.0)).acceleration(q, np.zeros(2), np.ones(2))
    assert np.allclose(plant.acceleration(np.ones(2)), true, rtol=1e-10)


def test_readings_cannot_be_written(make_scenario, two_link):
    plant = Plant(make_scenario(), two_link)
    with pytest.raises(ValueError, match="read-only"):
        plant.q[0] = 1.0


def test_a_state_that_is_not_finite_is_not_replaced_by_the_start(make_scenario, two_link):
    plant = Plant(make_scenario(), two_link)
    plant.reset(np.array([0.5, 0.5]), np.array([np.nan, 0.0]))
    plant.step(np.zeros(2))
    assert not np.isfinite(plant.qd).all()


def test_every_element_of_the_shipped_model_is_named(two_link):
    model = mujoco.MjModel.from_xml_string(two_link.text)
    counts = {"body": model.nbody, "joint": model.njnt, "geom": model.ngeom, "site": model.nsite}
    counts |= {"actuator": model.nu, "sensor": model.nsensor, "light": model.nlight}
    for kind, count in counts.items():
        names = [
            mujoco.mj_id2name(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), i)
            for i in range(count)
        ]
        assert all(names), (kind, names)


def test_dm_control_steps_the_same_model_to_the_same_state(make_scenario, two_link):
    scenario = make_scenario()
    plant = Plant(scenario, two_link)
    physics = dm_mujoco.Physics.from_xml_string(two_link.text)
    start, tau = np.array([0.5, 0.5]), np.array([20.0, 5.0])
    plant.reset(start, np.zeros(2))
    with physics.reset_context():
        physics.data.qpos[:] = start
    physics.set_control(tau)
    for _ in range(200):
        plant.step(tau)
    physics.step(200)
    assert np.allclose(physics.data.qpos, plant.q, rtol=0, atol=1e-12)
    assert np.allclose(physics.data.qvel, plant.qd, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<motor name="motor2" joint="joint2"/>', "", "1 actuators for 2 joints"),
        ('<motor gear="1"', '<motor gear="3"', 'gear="1"'),
        (
            '<joint name="joint2"/>',
            '<joint name="joint2"/><joint name="b" type="ball"/>',
            "hinges and slides",
        ),
        ('ctrllimited="false"', 'ctrlrange="-1 1"', "without ctrlrange"),
        ('name="motor1" joint="joint1"', 'name="motor1" joint="joint2"', "order of the joints"),
        ('name="motor1" joint="joint1"', 'name="motor1" site="tip"', "order of the joints"),
        ('name="link2"', 'name="forearm"', "no body 'link2'"),
        ("<worldbody>", "<wordbody>", "not XML: mismatched tag"),
        ('<joint name="joint1"', '<joint nome="joint1"', "MuJoCo says"),
    ],
)
def test_models_it_cannot_drive_are_refused_by_name(make_scenario, two_link, old, new, message):
    assert old in two_link.text
    with pytest.raises(ScenarioError, match=message):
        Plant(make_scenario(), Mjcf(two_link.text.replace(old, new)))


def test_includes_are_put_in_and_assets_found_beside_the_model(make_scenario, two_link, tmp_path):
    part = re.search(r"  <sensor>.*</sensor>\n", two_link.text, re.DOTALL).group()
    (tmp_path / "inner.xml").write_text(f"<mujocoinclude>{part}</mujocoinclude>")
    outer = '<mujocoinclude><include file="inner.xml"/></mujocoinclude>'
    (tmp_path / "outer.xml").write_text(outer)
    (tmp_path / "hand.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    mesh = '<asset><mesh name="hand" file="hand.obj" inertia="legacy"/></asset><worldbody>'
    text = two_link.text.replace(part, '<include file="outer.xml"/>')
    text = text.replace("<worldbody>", mesh, 1)
    text = text.replace(
        '<site name="tip"', '<geom name="hand" type="mesh" mesh="hand"/><site name="tip"'
    )
    (tmp_path / "arm.xml").write_text(text)
    read = Mjcf.read(tmp_path / "arm.xml")
    model = Plant(make_scenario(), read).model
    assert (model.nsensor, model.nmesh) == (4, 1)
    with pytest.raises(ScenarioError, match=r"hand\.obj"):
        Plant(make_scenario(), Mjcf(read.text, "elsewhere"))


def test_an_include_that_is_missing_or_includes_itself_is_refused(two_link, tmp_path):
    text = two_link.text.replace("<sensor>", '<include file="arm.xml"/><sensor>')
    lost = text.replace("arm.xml", "no.xml")
    for name, content, why in (("arm.xml", text, "again"), ("lost.xml", lost, "no such file")):
        (tmp_path / name).write_text(content)
        with pytest.raises(ScenarioError, match=why):
            Mjcf.read(tmp_path / name)


def test_a_model_with_another_number_of_joints_is_refused(make_scenario, two_link):
    plant = {"masses": None, "lengths": None}
    reference = {"kind": "sinusoid"}
    scenario = make_scenario(plant=plant, initial={"q": [0.0] * 3}, reference=reference)
    with pytest.raises(ScenarioError, match=r"initial\.q has 3 entries; allowed: 2"):
        Plant(scenario, two_link)
