"""Forces that the controller and its theory do not know: refused by name; all else is taken."""

from __future__ import annotations

from pathlib import Path

import dm_control
import numpy as np
import pytest

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.plant import Mjcf, NominalModel, Plant
from dnnmso_mj.simulation import simulate

ARM = """<mujoco><default><geom contype="0" conaffinity="0"/></default><worldbody>
  <geom name="floor" type="plane" size="1 1 1"/>
  <body name="upper">
    <joint name="shoulder" axis="0 -1 0"/><geom name="bone" size="0.1" mass="1"/>
    <site name="a"/>
    <body name="lower" pos="1 0 0">
      <joint name="elbow" axis="0 -1 0"/><geom name="hand" size="0.1" pos="1 0 0" mass="1"/>
      <site name="b" pos="1 0 0"/>
    </body>
  </body>
</worldbody>
<actuator><motor name="m1" joint="shoulder"/><motor name="m2" joint="elbow"/></actuator></mujoco>"""
ELBOW = 'name="elbow"'


def plant_of(make_scenario, text, folder=""):
    return Plant(make_scenario(plant={"model": "mine.xml"}), Mjcf(text, folder))


REFUSED = {
    "damping": (ELBOW, f'{ELBOW} damping="0.1"', "joint 'elbow' has damping; set damping=\"0\""),
    "friction": (ELBOW, f'{ELBOW} frictionloss="2"', "joint 'elbow' has frictionloss"),
    "spring": (ELBOW, f'{ELBOW} stiffness="2"', "joint 'elbow' has stiffness"),
    "limit": (ELBOW, f'{ELBOW} range="-1 1"', "joint 'elbow' has a range; set limited=\"false\""),
    "joint's torque limit": (ELBOW, f'{ELBOW} actuatorfrcrange="-1 1"', "imperfections.torque_li"),
    "motor's torque limit": ('name="m2"', 'name="m2" forcerange="-1 1"', "motor 'm2' has forcera"),
    "a thing to touch": (
        'size="1 1 1"',
        'size="1 1 1" contype="1" conaffinity="1"',
        None,  # nothing else collides with it
    ),
    "contact with the floor": (
        'contype="0" conaffinity="0"/></default>',
        'contype="1" conaffinity="1"/></default>',
        "geoms 'floor' and 'bone' can touch; set contype=\"0\"",
    ),
    "a contact pair": (
        "<actuator>",
        '<contact><pair geom1="floor" geom2="hand"/></contact><actuator>',
        "geoms 'floor' and 'hand' can touch",
    ),
    "equality": (
        "<actuator>",
        '<equality><joint name="geared" joint1="elbow" joint2="shoulder"/></equality><actuator>',
        "equality 'geared' is active",
    ),
    "tendon": (
        "<actuator>",
        '<tendon><fixed name="band" stiffness="3"><joint joint="elbow" coef="1"/></fixed></tendon>'
        "<actuator>",
        "tendon 'band' has stiffness",
    ),
    "gravity compensation": ('name="lower"', 'name="lower" gravcomp="1"', "'lower' has gravcomp"),
    "drag": ("<worldbody>", '<option density="1.2"/><worldbody>', "density or viscosity"),
    "no gravity": (
        "<worldbody>",
        '<option><flag gravity="disable"/></option><worldbody>',
        'switches off gravity; set gravity="enable"',
    ),
    "no motors": (
        "<worldbody>",
        '<option><flag actuation="disable"/></option><worldbody>',
        "switches off actuation",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_force_that_falsifies_a_run_is_refused_by_name(make_scenario, case):
    old, new, message = REFUSED[case]
    assert ARM.count(old) == 1
    text = ARM.replace(old, new)
    if message is None:
        plant_of(make_scenario, text)
        return
    with pytest.raises(ScenarioError) as caught:
        plant_of(make_scenario, text)
    assert message in str(caught.value)
    assert str(caught.value).startswith("plant.model = mine.xml: ")


@pytest.mark.parametrize(
    ("case", "flag"),
    [
        ("damping", "damper"),
        ("friction", "frictionloss"),
        ("spring", "spring"),
        ("limit", "limit"),
        ("limit", "constraint"),
        ("contact with the floor", "contact"),
        ("equality", "equality"),
    ],
)
def test_what_the_model_itself_switches_off_is_taken(make_scenario, case, flag):
    old, new, _ = REFUSED[case]
    off = f'<option><flag {flag}="disable"/></option><worldbody>'
    plant_of(make_scenario, ARM.replace(old, new).replace("<worldbody>", off))


def test_links_next_to_each_other_may_overlap(make_scenario):
    """MuJoCo lets a body and its parent never collide."""
    apart = ARM.replace('contype="0" conaffinity="0"', "").replace("floor", "base")
    apart = apart.replace('<geom name="base" type="plane" size="1 1 1"/>', "")
    plant_of(make_scenario, apart)
    far = '<body pos="1 0 0"><geom name="tool" size="0.1"/></body><site name="b"'
    plant_of(make_scenario, apart.replace('<site name="b"', far))  # welded to the lower link
    world = apart.replace("<worldbody>", '<worldbody><geom name="wall" size="0.1" pos="0 0 1"/>')
    with pytest.raises(ScenarioError, match="geoms 'wall' and 'bone' can touch"):
        plant_of(make_scenario, world)


def test_many_faults_are_told_together_and_cut_short(make_scenario):
    text = ARM.replace("axis=", 'damping="1" frictionloss="1" stiffness="1" range="-1 1" axis=')
    with pytest.raises(ScenarioError, match="and 3 more"):
        plant_of(make_scenario, text)


@pytest.mark.parametrize("where", ["joint", "motor"])
def test_armature_is_part_of_the_inertia_that_controller_and_plant_share(make_scenario, where):
    """M⁻¹ of the controller's model is what the plant does with a torque, armature included."""
    bare = ARM.replace(ELBOW, f'{ELBOW} armature="0.5"')
    if where == "motor":
        bare = ARM.replace('name="m2"', 'name="m2" armature="0.5"')
    scenario = make_scenario(plant={"model": "mine.xml"})
    plant, nominal = Plant(scenario, Mjcf(bare)), NominalModel(scenario, Mjcf(bare))
    q, qd, tau = np.array([0.3, 0.9]), np.array([1.0, -2.0]), np.array([5.0, 3.0])
    M, bias = nominal.inertia(q).copy(), nominal.bias(q, qd).copy()
    plain = NominalModel(scenario, Mjcf(ARM)).inertia(q)
    assert np.allclose(M - plain, np.diag([0.0, 0.5]), atol=1e-12)
    plant.reset(q, qd)
    assert np.allclose(plant.acceleration(tau), np.linalg.solve(M, tau - bias), rtol=1e-10)


JACO = Path(dm_control.__file__).parent / "third_party" / "kinova" / "jaco_arm.xml"


def test_a_robot_of_six_joints_is_refused_as_it_comes_and_driven_once_mended(make_scenario):
    """dm_control's Kinova Jaco: frictions, limits and contacts off, a motor for each joint."""
    mjcf = Mjcf.read(JACO)
    motors = "".join(f'<motor joint="joint_{k}"/>' for k in range(1, 7))
    driven = mjcf.text.replace("</mujoco>", f"<actuator>{motors}</actuator></mujoco>")
    parts = {
        "plant": {"model": "jaco"},
        "initial": {"q": [0.0, 3.0, 3.0, 0.0, 0.0, 0.0]},
        "reference": {"kind": "sinusoid", "amplitude": 0.1, "offset": [0, 3, 3, 0, 0, 0]},
        "duration": 0.2,
    }
    scenario = make_scenario({"kind": "no_network"}, **parts)
    with pytest.raises(ScenarioError, match=r"'joint_1' has damping; .* more"):
        Plant(scenario, Mjcf(driven, mjcf.folder))
    off = '<option><flag damper="disable" constraint="disable"/></option>'
    mended = Mjcf(driven.replace("<worldbody>", f"{off}<worldbody>", 1), mjcf.folder)
    trace = simulate(scenario, mended)
    assert trace.info.status == "ok"
    assert len(trace) == 200
    assert float(np.abs(trace["q"] - trace["q_ref"]).max()) < 0.2
