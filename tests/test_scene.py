"""The picture of a robot is where MuJoCo says the robot is; its URDF is the same robot."""

from __future__ import annotations

import xml.etree.ElementTree as Xml
from pathlib import Path

import mujoco
import numpy as np
import pinocchio
import pytest

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.rotations import from_rotation_vector, matrix, multiply, rotate, rpy
from dnnmso_mj.scene import Scene

TWO_LINK = Path(__file__).parents[1] / "models" / "two_link.xml"

# A tree with all that is awkward: slides, two joints in a body, a joint off its body's origin,
# reference angles, welded and unnamed bodies, turned inertias, limits, every shape.
TREE = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <asset>
    <material name="red" rgba="0.8 0.1 0.1 1"/>
    <mesh name="wedge" vertex="0 0 0  0.4 0 0  0 0.2 0  0 0 0.1"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <geom name="base" type="box" size="0.1 0.2 0.3" pos="0 0 -0.3" material="red"/>
    <body name="cart" pos="0.1 0 0.2" euler="0.3 0.2 0.1">
      <joint name="rail" type="slide" axis="1 2 0" range="-2 2" ref="0.3"/>
      <geom name="puck" type="cylinder" size="0.1 0.05" mass="1.5" euler="0.4 0 0"/>
      <body name="arm" pos="0 0.1 0" euler="0 1.1 0">
        <joint name="shoulder" axis="0 1 0" pos="0.1 0 0.2" ref="0.7"/>
        <joint name="twist" axis="1 0 1" range="-3 3" pos="0 0.05 0"/>
        <geom name="bone" type="capsule" fromto="0 0 0 0.8 0 0" size="0.03" mass="0.7"/>
        <body pos="0.8 0 0" euler="0.5 0 0">
          <geom name="egg" type="ellipsoid" size="0.1 0.05 0.03" mass="0.2"/>
          <site name="tip" pos="0.1 0.2 0.3"/>
        </body>
      </body>
      <body name="other" pos="0 -0.1 0">
        <joint name="elbow" axis="0 0 -1"/>
        <geom name="ball" type="sphere" size="0.05" pos="0.3 0 0" mass="0.4"/>
        <geom name="wedge" type="mesh" mesh="wedge" mass="0.1"/>
        <geom name="collision" type="box" size="1 1 1" group="3" mass="0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def two_link() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(TWO_LINK))


def tree() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(TREE)


MODELS = pytest.mark.parametrize("model", [two_link(), tree()], ids=["two_link", "tree"])


def random_q(model: mujoco.MjModel, count: int = 30) -> np.ndarray:
    return np.random.default_rng(7).uniform(-3.0, 3.0, (count, model.nq))


def kinematics(model: mujoco.MjModel, q: np.ndarray) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    return data


def world_poses(scene: Scene, q: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Compose parent -> child down the tree: name -> position, rotation matrix."""
    poses = {"world": (np.zeros(3), np.eye(3))}
    for link, pose in zip(scene.links, scene.transforms(q), strict=True):
        xyz, turn = poses[link.parent]
        poses[link.name] = (xyz + turn @ pose[:3], turn @ matrix(pose[3:]))
    return poses


@MODELS
def test_links_are_where_mujoco_has_its_bodies(model: mujoco.MjModel) -> None:
    scene = Scene(model)
    for q in random_q(model):
        data, poses = kinematics(model, q), world_poses(scene, q)
        for body in range(1, model.nbody):
            xyz, turn = poses[model.body(body).name or f"body{body}"]
            np.testing.assert_allclose(xyz, data.xpos[body], atol=1e-12)
            np.testing.assert_allclose(turn, data.xmat[body].reshape(3, 3), atol=1e-12)


@MODELS
def test_shapes_are_where_mujoco_has_its_geoms(model: mujoco.MjModel) -> None:
    scene, q = Scene(model), random_q(model)[0]
    data, poses = kinematics(model, q), world_poses(scene, q)
    for geom in scene.geoms:
        xyz, turn = poses[geom.body]
        if geom.name != "wedge":  # a mesh is shown by a box around it, tested below
            expected = data.geom(geom.name)
            np.testing.assert_allclose(xyz + turn @ geom.xyz, expected.xpos, atol=1e-12)
            np.testing.assert_allclose(
                turn @ matrix(geom.quat_xyzw), expected.xmat.reshape(3, 3), atol=1e-12
            )


@MODELS
def test_tip_is_where_mujoco_has_the_site(model: mujoco.MjModel) -> None:
    q = random_q(model)
    expected = [kinematics(model, row).site("tip").xpos for row in q]
    np.testing.assert_allclose(Scene(model).tip(q), expected, atol=1e-12)


def test_tip_without_a_site_is_the_last_body() -> None:
    spec = mujoco.MjSpec.from_file(str(TWO_LINK))
    spec.delete(spec.site("tip"))
    model = spec.compile()
    q = random_q(model)[0]
    np.testing.assert_allclose(Scene(model).tip(q), kinematics(model, q).xpos[-1], atol=1e-12)


@MODELS
def test_many_states_at_once_are_the_same_as_one_by_one(model: mujoco.MjModel) -> None:
    scene, q = Scene(model), random_q(model, 5)
    many = scene.transforms(q)
    assert many.shape == (5, len(scene.links), 7)
    np.testing.assert_array_equal(many, [scene.transforms(row) for row in q])
    np.testing.assert_allclose(np.linalg.norm(many[..., 3:], axis=-1), 1.0, atol=1e-12)


def test_shapes_have_the_sizes_and_colours_of_the_model() -> None:
    geoms = {geom.name: geom for geom in Scene(tree()).geoms}
    assert set(geoms) == {"base", "puck", "bone", "egg", "ball", "wedge"}  # no floor, no collision
    assert (geoms["base"].body, geoms["base"].shape) == ("world", "box")
    assert geoms["base"].size == (0.1, 0.2, 0.3)
    assert geoms["base"].rgba == pytest.approx((0.8, 0.1, 0.1, 1.0))  # its material's
    assert (geoms["puck"].shape, geoms["puck"].size[:2]) == ("cylinder", (0.1, 0.05))
    assert (geoms["bone"].shape, geoms["bone"].size[:2]) == ("capsule", (0.03, 0.4))
    assert (geoms["egg"].shape, geoms["egg"].body) == ("ellipsoid", "body3")
    assert (geoms["ball"].shape, geoms["ball"].size[0]) == ("sphere", 0.05)


def test_a_mesh_shows_as_the_box_around_it() -> None:
    wedge = next(geom for geom in Scene(tree()).geoms if geom.name == "wedge")
    vertices = np.array([[0, 0, 0], [0.4, 0, 0], [0, 0.2, 0], [0, 0, 0.1]])
    inside = (vertices - wedge.xyz) @ matrix(wedge.quat_xyzw)  # in the box's frame
    assert wedge.shape == "box"
    assert (np.abs(inside) <= np.array(wedge.size) + 1e-6).all()
    assert np.prod(wedge.size) * 8 < 0.03  # and it is not a box far too large


def test_a_ball_joint_is_refused_by_name() -> None:
    xml = TREE.replace('axis="0 0 -1"', 'type="ball"')
    with pytest.raises(ScenarioError, match=r"'elbow' is of type ball; allowed: hinge, slide"):
        Scene(mujoco.MjModel.from_xml_string(xml))


def pinocchio_state(model: pinocchio.Model, mj: mujoco.MjModel, q: np.ndarray) -> np.ndarray:
    """Pinocchio's q: another order of joints, and (cos, sin) for one without limits."""
    out = pinocchio.neutral(model)
    for name in model.names[1:]:
        joint = model.joints[model.getJointId(name)]
        angle = q[mj.joint(name).qposadr[0]]
        wide = joint.nq == 2
        out[joint.idx_q : joint.idx_q + joint.nq] = (
            [np.cos(angle), np.sin(angle)] if wide else angle
        )
    return out


@MODELS
def test_urdf_kinematics_by_pinocchio_equal_mujoco(model: mujoco.MjModel) -> None:
    robot = pinocchio.buildModelFromXML(Scene(model).urdf())
    data = robot.createData()
    assert robot.nv == model.nv
    for q in random_q(model):
        expected = kinematics(model, q)
        pinocchio.framesForwardKinematics(robot, data, pinocchio_state(robot, model, q))
        for body in range(1, model.nbody):
            pose = data.oMf[robot.getFrameId(model.body(body).name or f"body{body}")]
            np.testing.assert_allclose(pose.translation, expected.xpos[body], atol=1e-12)
            np.testing.assert_allclose(pose.rotation, expected.xmat[body].reshape(3, 3), atol=1e-12)


@MODELS
def test_urdf_masses_and_inertias_by_pinocchio_equal_mujoco(model: mujoco.MjModel) -> None:
    robot = pinocchio.buildModelFromXML(Scene(model).urdf())
    data = robot.createData()
    order = [robot.joints[robot.getJointId(model.joint(k).name)].idx_v for k in range(model.nv)]
    assert pinocchio.computeTotalMass(robot) == pytest.approx(model.body_mass.sum(), rel=1e-12)
    for q in random_q(model):
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, kinematics(model, q), inertia)
        found = pinocchio.crba(robot, data, pinocchio_state(robot, model, q))
        np.testing.assert_allclose(found[np.ix_(order, order)], inertia, atol=1e-12)


@MODELS
def test_urdf_shapes_stand_where_the_geoms_do(model: mujoco.MjModel) -> None:
    scene = Scene(model)
    robot = Xml.fromstring(scene.urdf())
    visuals = {v.attrib["name"]: v for v in robot.iter("visual")}
    for geom in scene.geoms:
        origin = visuals[geom.name].find("origin")
        assert origin is not None
        xyz = np.array(origin.attrib["xyz"].split(), dtype=float)
        roll, pitch, yaw = map(float, origin.attrib["rpy"].split())
        np.testing.assert_allclose(xyz, geom.xyz, atol=1e-12)
        turn = pinocchio.rpy.rpyToMatrix(roll, pitch, yaw)
        np.testing.assert_allclose(turn, matrix(geom.quat_xyzw), atol=1e-12)


def test_urdf_capsule_is_a_cylinder_closed_by_two_spheres() -> None:
    scene = Scene(two_link())
    link = next(e for e in Xml.fromstring(scene.urdf()) if e.attrib.get("name") == "link1")
    parts = [v for v in link.iter("visual") if v.attrib["name"].startswith("rod1")]
    ends = [np.array(p.find("origin").attrib["xyz"].split(), dtype=float) for p in parts]
    assert [p.find("geometry")[0].tag for p in parts] == ["cylinder", "sphere", "sphere"]
    assert parts[0].find("geometry")[0].attrib == {"radius": "0.035", "length": "1.0"}
    np.testing.assert_allclose(sorted(end[0] for end in ends), [0.0, 0.5, 1.0], atol=1e-12)
    np.testing.assert_allclose(np.array(ends)[:, 1:], 0.0, atol=1e-12)


def test_urdf_limits_only_what_the_model_limits() -> None:
    robot = Xml.fromstring(Scene(tree()).urdf())
    kinds = {j.attrib["name"]: j.attrib["type"] for j in robot.iter("joint")}
    assert kinds == {
        "rail": "prismatic",
        "shoulder": "continuous",
        "twist": "revolute",
        "elbow": "continuous",
        "arm_fixed": "fixed",
        "body3_fixed": "fixed",
    }
    twist = robot.find("joint[@name='twist']/limit")
    assert twist is not None
    assert (twist.attrib["lower"], twist.attrib["upper"]) == ("-3.0", "3.0")


@MODELS
def test_urdf_loads_in_rerun(model: mujoco.MjModel, tmp_path: Path) -> None:
    import rerun as rr
    from rerun.chunk import RrdReader

    scene, urdf, rrd = Scene(model), tmp_path / "robot.urdf", tmp_path / "robot.rrd"
    urdf.write_text(scene.urdf())
    recording = rr.RecordingStream("test")
    recording.save(rrd)
    recording.log_file_from_path(urdf, static=True)
    recording.disconnect()
    chunks = list(RrdReader(rrd).stream())
    shown = {"/".join(chunk.entity_path.split("/")[-2:]) for chunk in chunks}
    assert {f"{geom.body}/{geom.name}" for geom in scene.geoms} <= shown
    frames = next(c.to_record_batch() for c in chunks if c.entity_path == "/tf_static")
    children = frames["Transform3D:child_frame"].to_pylist()
    assert {child for row in children for child in row} == {link.name for link in scene.links}


@pytest.mark.parametrize("pitch", [0.3, np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9])
def test_roll_pitch_yaw_keep_every_digit_up_to_a_right_angle(pitch: float) -> None:
    angles, axes = (0.7, pitch, -0.4), np.eye(3)[::-1]
    z, y, x = (from_rotation_vector(a * axis) for a, axis in zip(angles, axes, strict=True))
    quat = multiply(multiply(z, y), x)
    found = pinocchio.rpy.rpyToMatrix(*rpy(quat))
    np.testing.assert_allclose(found, matrix(quat), atol=1e-14)


def test_quaternions_turn_as_their_matrices_do() -> None:
    rng = np.random.default_rng(3)
    vectors, turns = rng.normal(size=(20, 3)), rng.normal(size=(20, 3))
    quats = np.array([from_rotation_vector(turn) for turn in turns])
    expected = [matrix(quat) @ vector for quat, vector in zip(quats, vectors, strict=True)]
    np.testing.assert_allclose(rotate(quats, vectors), expected, atol=1e-14)
