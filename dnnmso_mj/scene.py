"""The robot as a picture: links, joints and shapes of a compiled MuJoCo model, without its physics.

Every transform is [x, y, z, qx, qy, qz, qw]: metres, and a unit quaternion with its scalar last, as
Rerun, Foxglove and ROS have it (MuJoCo has it first).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.rotations import IDENTITY, from_rotation_vector, multiply, rotate, xyzw
from dnnmso_mj.urdf import urdf_text

Array = np.ndarray
Shape = Literal["capsule", "sphere", "box", "cylinder", "ellipsoid"]

WORLD = "world"
_SHAPES: dict[int, Shape] = {
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoid",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
}
_HIDDEN_GROUP = 3  # MuJoCo's own viewers hide the geom groups from 3 on: collision shapes
_DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)  # what a geom without a colour has in MuJoCo


@dataclass(frozen=True)
class Geom:
    """One shape fixed to a link; `size` holds MuJoCo's half sizes, of which a shape uses 1 to 3."""

    name: str
    body: str
    shape: Shape
    size: tuple[float, float, float]  # m
    xyz: Array  # (3,) m, in the link's frame
    quat_xyzw: Array  # (4,)
    rgba: tuple[float, float, float, float]


@dataclass(frozen=True)
class Joint:
    """What moves a link against its parent; `axis` in the link's frame, `index` its place in q."""

    name: str
    kind: Literal["hinge", "slide"]
    axis: Array  # (3,)
    index: int
    limits: tuple[float, float] | None  # rad or m


@dataclass(frozen=True)
class Inertial:
    """Mass (kg), centre of mass (3,) and inertia about it (3, 3) (kg·m²), in the link's frame."""

    mass: float
    com: Array
    inertia: Array


@dataclass(frozen=True)
class Link:
    """One frame of the tree: its place in its parent's frame at q = 0, and what moves it."""

    name: str
    parent: str  # a link's name, or "world"
    xyz: Array  # (3,) m
    quat_xyzw: Array  # (4,)
    joint: Joint | None
    inertial: Inertial | None


class Scene:
    """Links and shapes of a robot, and where they are at given joint angles.

    The links are the bodies of the model. A body whose joint does not pass through its origin, or
    that has several joints, gets one frame more for each, named "body.joint", so that `transforms`
    and `urdf` have the same links. A mesh, a height field or an SDF shows as its bounding box; a
    plane, an invisible geom and the collision shapes of group 3 and above do not show.

    Args:
        model: any compiled model whose joints are all hinges and slides.

    Attributes:
        links, geoms: its parts.
        tip_place: the link that the tip is on, and where in that link's frame (3,) m.

    Raises:
        ScenarioError: a joint is free or a ball.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._gather(tuple(_links(model)), tuple(_geoms(model)), _tip_place(model))

    @classmethod
    def of(
        cls, links: tuple[Link, ...], geoms: tuple[Geom, ...], tip_place: tuple[str, Array]
    ) -> Scene:
        """A scene of the parts of another: its `links`, `geoms` and `tip_place`."""
        scene = cls.__new__(cls)
        scene._gather(links, geoms, tip_place)
        return scene

    def _gather(
        self, links: tuple[Link, ...], geoms: tuple[Geom, ...], tip_place: tuple[str, Array]
    ) -> None:
        self.links, self.geoms, self.tip_place = links, geoms, tip_place
        joints = [link.joint for link in self.links]
        self._xyz = np.array([link.xyz for link in self.links]).reshape(-1, 3)
        self._quat = np.array([link.quat_xyzw for link in self.links]).reshape(-1, 4)
        axis = np.array([j.axis if j else np.zeros(3) for j in joints]).reshape(-1, 3)
        self._index = np.array([j.index if j else 0 for j in joints], dtype=int)
        turns = np.array([[bool(j and j.kind == "hinge")] for j in joints]).reshape(-1, 1)
        # Per radian and per metre: what a joint adds is linear in sin(q/2), cos(q/2) and q.
        self._half = 0.5 * turns[:, 0]
        self._turn = multiply(self._quat, np.pad(turns * axis, ((0, 0), (0, 1))))
        self._slide = rotate(self._quat, ~turns * axis)
        self._tip_chain = list(self._chain(tip_place[0]))

    def transforms(self, q: Array) -> Array:
        """Each link in its parent's frame, in the order of `links`.

        Args:
            q: joint angles (rad; m for a slide), shape (..., n): one state or many.

        Returns:
            [xyz, quat_xyzw] of each link, shape (..., n_links, 7).
        """
        q_link = np.asarray(q, dtype=float)[..., self._index]  # (..., n_links)
        half = (self._half * q_link)[..., None]
        out = np.empty((*q_link.shape, 7))
        out[..., :3] = self._xyz + self._slide * q_link[..., None]
        out[..., 3:] = self._turn * np.sin(half) + self._quat * np.cos(half)
        return out

    def tip(self, q: Array) -> Array:
        """World position (m) of the site named "tip", or of the last body: (..., n) -> (..., 3)."""
        poses = self.transforms(q)
        point = np.broadcast_to(self.tip_place[1], (*poses.shape[:-2], 3))
        for k in self._tip_chain:
            point = poses[..., k, :3] + rotate(poses[..., k, 3:], point)
        return point

    @property
    def reach(self) -> float:
        """How far a point of the robot can be from the origin (m), roughly."""
        frames = sum(float(np.linalg.norm(link.xyz)) for link in self.links)
        shapes = [float(np.linalg.norm(geom.xyz)) + max(geom.size) for geom in self.geoms]
        return frames + max(shapes, default=0.0)

    def urdf(self) -> str:
        """The links, joints, shapes and masses as URDF text.

        A capsule becomes a cylinder and two spheres, an ellipsoid its bounding box.
        """
        return urdf_text(self.links, self.geoms)

    def _chain(self, name: str) -> Iterator[int]:
        """The places of the links from a link up to the root."""
        places = {link.name: k for k, link in enumerate(self.links)}
        while name != WORLD:
            yield places[name]
            name = self.links[places[name]].parent


def _tip_place(model: mujoco.MjModel) -> tuple[str, Array]:
    """The link that the tip is on, and where in that link's frame (m)."""
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, "tip")
    body = model.nbody - 1 if site < 0 else model.site_bodyid[site]
    return _body_name(model, body), np.zeros(3) if site < 0 else np.array(model.site_pos[site])


def _links(model: mujoco.MjModel) -> Iterator[Link]:
    """Walk the bodies, parents first; a frame for each joint, the last one being the body itself.

    A body is placed by T₀ · Π_j Trans(p_j) · Rot(a_j, q_j − q0_j) · Trans(−p_j), so a frame's place
    at q = 0 gathers the constant factors since the frame before it.
    """
    for body in range(1, model.nbody):
        name, parent = _body_name(model, body), _body_name(model, model.body_parentid[body])
        xyz, quat = np.array(model.body_pos[body]), xyzw(model.body_quat[body])
        first, count = model.body_jntadr[body], model.body_jntnum[body]
        for k in range(first, first + count):
            joint, anchor = _joint(model, k), np.array(model.jnt_pos[k])
            xyz = xyz + rotate(quat, anchor)
            offset = -model.qpos0[joint.index] * joint.axis
            if joint.kind == "hinge":
                quat = multiply(quat, from_rotation_vector(offset))
            else:
                xyz = xyz + rotate(quat, offset)
            if k == first + count - 1 and not anchor.any():
                yield Link(name, parent, xyz, quat, joint, _inertial(model, body))
                break
            frame = f"{name}.{joint.name}"
            yield Link(frame, parent, xyz, quat, joint, None)
            parent, xyz, quat = frame, -anchor, IDENTITY
        else:
            yield Link(name, parent, xyz, quat, None, _inertial(model, body))


def _joint(model: mujoco.MjModel, k: int) -> Joint:
    name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, k) or f"joint{k}"
    kind = mujoco.mjtJoint(model.jnt_type[k])
    if kind not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
        kind_name = kind.name.removeprefix("mjJNT_").lower()
        raise ScenarioError(
            f"joint {name!r} is of type {kind_name}; allowed: hinge, slide. "
            "Weld the body to the world, or give it hinge and slide joints."
        )
    low, high = map(float, model.jnt_range[k])
    return Joint(
        name=name,
        kind="hinge" if kind == mujoco.mjtJoint.mjJNT_HINGE else "slide",
        axis=np.array(model.jnt_axis[k]),
        index=int(model.jnt_qposadr[k]),
        limits=(low, high) if model.jnt_limited[k] else None,
    )


def _inertial(model: mujoco.MjModel, body: int) -> Inertial | None:
    if model.body_mass[body] == 0.0:
        return None
    turn = rotate(xyzw(model.body_iquat[body]), np.eye(3)).T  # columns: principal axes
    inertia = turn @ np.diag(model.body_inertia[body]) @ turn.T
    return Inertial(float(model.body_mass[body]), np.array(model.body_ipos[body]), inertia)


def _geoms(model: mujoco.MjModel) -> Iterator[Geom]:
    for k in range(model.ngeom):
        kind = int(model.geom_type[k])
        rgba = _rgba(model, k)
        is_plane = kind == mujoco.mjtGeom.mjGEOM_PLANE  # infinite: a picture is better without it
        if is_plane or model.geom_group[k] >= _HIDDEN_GROUP or rgba[3] == 0.0:
            continue
        xyz, quat = np.array(model.geom_pos[k]), xyzw(model.geom_quat[k])
        size = model.geom_size[k]
        if kind not in _SHAPES:  # no closed form: the box around it
            centre, size = model.geom_aabb[k, :3], model.geom_aabb[k, 3:]
            xyz = xyz + rotate(quat, centre)
        yield Geom(
            name=mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, k) or f"geom{k}",
            body=_body_name(model, model.geom_bodyid[k]),
            shape=_SHAPES.get(kind, "box"),
            size=(float(size[0]), float(size[1]), float(size[2])),
            xyz=xyz,
            quat_xyzw=quat,
            rgba=rgba,
        )


def _rgba(model: mujoco.MjModel, geom: int) -> tuple[float, float, float, float]:
    """The geom's colour; its material's, when it has none of its own."""
    own, material = model.geom_rgba[geom], model.geom_matid[geom]
    if material >= 0 and np.allclose(own, _DEFAULT_RGBA):
        own = model.mat_rgba[material]
    red, green, blue, alpha = map(float, own)
    return red, green, blue, alpha


def _body_name(model: mujoco.MjModel, body: int) -> str:
    return mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, body) or f"body{body}"
