"""What a log says to general viewers: frames and shapes in schemas Foxglove and Rerun know.

The arm's frames bear the names of its links. The desired arm, a translucent ghost, has the same
frames under "ref/".
"""

from __future__ import annotations

import struct

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.CylinderPrimitive_pb2 import CylinderPrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.SpherePrimitive_pb2 import SpherePrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3

from dnnmso_mj.log.format import NS_PER_S, Topic, protobuf_topic, timestamp
from dnnmso_mj.rotations import rotate
from dnnmso_mj.scene import WORLD, Geom, Scene

Array = np.ndarray

GHOST = "ref/"
_GHOST_OPACITY = 0.3


TF = protobuf_topic("/tf", FrameTransforms.DESCRIPTOR.file, "foxglove.FrameTransforms")
SCENE = protobuf_topic("/scene", SceneUpdate.DESCRIPTOR.file, "foxglove.SceneUpdate")
# Rerun looks for a robot only where ROS 2 publishes one: a string on this very topic.
ROBOT_DESCRIPTION = Topic(
    "/robot_description", "std_msgs/msg/String", "ros2msg", b"string data\n", "cdr"
)


def robot_description(urdf: str) -> bytes:
    """URDF text as a ROS 2 string: little-endian CDR, zero-terminated."""
    text = urdf.encode() + b"\0"
    return b"\x00\x01\x00\x00" + struct.pack("<I", len(text)) + text


class FrameMessages:
    """Makes messages on /tf: every link in its parent's frame, of the arm and of its ghost.

    Args:
        scene: the robot.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        # One message is filled again and again: making its parts anew takes longer than the rest.
        self._message = FrameTransforms(
            transforms=[
                FrameTransform(
                    timestamp=timestamp(0),
                    parent_frame_id=_frame(prefix, link.parent),
                    child_frame_id=_frame(prefix, link.name),
                    translation=Vector3(),
                    rotation=Quaternion(),
                )
                for prefix in ("", GHOST)
                for link in scene.links
            ]
        )
        self._parts = [(t.timestamp, t.translation, t.rotation) for t in self._message.transforms]

    def encode(self, times_ns: list[int], q: Array, q_ref: Array) -> list[bytes]:
        """One message a time.

        Args:
            times_ns: simulation times (ns), N of them.
            q: joint angles (rad), shape (N, n).
            q_ref: desired joint angles (rad), shape (N, n).
        """
        poses = self._scene.transforms(np.stack([q, q_ref], axis=1))  # (N, 2, n_links, 7)
        parts = poses.reshape(len(q), len(self._parts), 7).tolist()
        return [self._one(*at) for at in zip(times_ns, parts, strict=True)]

    def _one(self, time_ns: int, poses: list[list[float]]) -> bytes:
        seconds, nanos = divmod(time_ns, NS_PER_S)
        for (stamp, xyz, quat), pose in zip(self._parts, poses, strict=True):
            stamp.seconds, stamp.nanos = seconds, nanos
            xyz.x, xyz.y, xyz.z, quat.x, quat.y, quat.z, quat.w = pose
        return self._message.SerializeToString()


def scene_update(scene: Scene) -> bytes:
    """The shapes of every link, fixed to the link's frame, and again for the ghost."""
    bodies = dict.fromkeys(geom.body for geom in scene.geoms)
    arm = [_entity(scene, body, body, 1.0) for body in bodies]
    ghost = [_entity(scene, body, GHOST + body, _GHOST_OPACITY) for body in bodies if body != WORLD]
    return SceneUpdate(entities=[*arm, *ghost]).SerializeToString()


def _frame(prefix: str, name: str) -> str:
    return name if name == WORLD else prefix + name


def _entity(scene: Scene, body: str, frame: str, opacity: float) -> SceneEntity:
    entity = SceneEntity(id=frame, frame_id=frame, frame_locked=True)
    for geom in scene.geoms:
        if geom.body == body:
            _add_shapes(entity, geom, opacity)
    return entity


def _add_shapes(entity: SceneEntity, geom: Geom, opacity: float) -> None:
    """A geom as Foxglove's primitives, which have full sizes where MuJoCo has half sizes."""
    a, b, c = geom.size
    red, green, blue, alpha = geom.rgba
    color = Color(r=red, g=green, b=blue, a=alpha * opacity)

    def sphere(x: float, y: float, z: float, along_z: float = 0.0) -> SpherePrimitive:
        return SpherePrimitive(pose=_pose(geom, along_z), size=Vector3(x=x, y=y, z=z), color=color)

    match geom.shape:
        case "sphere":
            entity.spheres.append(sphere(2 * a, 2 * a, 2 * a))
        case "ellipsoid":
            entity.spheres.append(sphere(2 * a, 2 * b, 2 * c))
        case "box":
            size = Vector3(x=2 * a, y=2 * b, z=2 * c)
            entity.cubes.append(CubePrimitive(pose=_pose(geom), size=size, color=color))
        case "cylinder" | "capsule":
            entity.cylinders.append(
                CylinderPrimitive(
                    pose=_pose(geom),
                    size=Vector3(x=2 * a, y=2 * a, z=2 * b),
                    bottom_scale=1.0,
                    top_scale=1.0,
                    color=color,
                )
            )
            if geom.shape == "capsule":
                entity.spheres.extend(sphere(2 * a, 2 * a, 2 * a, end) for end in (b, -b))


def _pose(geom: Geom, along_z: float = 0.0) -> Pose:
    """The geom's place in its link, moved along the geom's own z axis (m)."""
    x, y, z = (geom.xyz + rotate(geom.quat_xyzw, np.array([0.0, 0.0, along_z]))).tolist()
    qx, qy, qz, qw = geom.quat_xyzw.tolist()
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
