"""The arm in Rerun's 3-D: links, joints, the trail of its tip, and the desired arm as a ghost."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import rerun as rr

from dnnmso_mj.rotations import from_rotation_vector
from dnnmso_mj.scene import WORLD, Geom, Joint, Scene
from dnnmso_mj.viewer.blueprint import ARM, DESIRED, TRAIL, Point
from dnnmso_mj.viewer.signals import joint_color

Array = np.ndarray
Rgba = tuple[int, int, int, int]

GHOST_RGBA: Rgba = (255, 255, 255, 60)
GHOST_SCALE = 0.9  # so that it vanishes in the arm where the arm is where it should be
PATH_RGB = (255, 255, 255)
TRAIL_RGB = (255, 220, 90)
SOLID = rr.components.FillMode.Solid


def send_arms(
    recording: rr.RecordingStream,
    scene: Scene,
    times: Sequence[rr.TimeColumn],
    q: Array,
    q_ref: Array,
) -> None:
    """Send the arm with its joints and the trail of its tip; the desired arm and its path.

    Args:
        recording: where to.
        scene: the robot.
        times: of the T poses.
        q, q_ref: joint angles and desired ones (rad), shape (T, n).
    """
    frames = _send_frames(recording, ARM, scene, times, q)
    ghost_frames = _send_frames(recording, DESIRED, scene, times, q_ref)
    for geom in scene.geoms:
        _log_shape(recording, frames[geom.body], geom, _rgba(geom))
        if geom.body != WORLD:
            _log_shape(recording, ghost_frames[geom.body], geom, GHOST_RGBA, GHOST_SCALE)
    reach = _reach(scene)
    for link in scene.links:
        if link.joint:
            pin = _pin(link.joint, 0.02 * reach)
            recording.log(f"{frames[link.name]}/shapes/pin", pin, static=True)
    radius = 0.004 * reach
    # Thinner than the trail, which so covers it where the tip has kept to it.
    path = rr.LineStrips3D([scene.tip(q_ref)], colors=PATH_RGB, radii=0.6 * radius)
    recording.log(f"{TRAIL}/desired", path, static=True)
    _send_trail(recording, times, scene.tip(q), radius)


def stage(scene: Scene, q: Array, q_ref: Array) -> tuple[Point, float]:
    """Centre and half size (m) of what a camera must show of the poses q, q_ref (T, n)."""
    points = np.concatenate([np.zeros((1, 3)), scene.tip(q), scene.tip(q_ref)])
    low, high, reach = points.min(axis=0), points.max(axis=0), _reach(scene)
    x, y, z = map(float, (low + high) / 2)
    return (x, y, z), max(float((high - low).max()) / 2, 0.4 * reach) + 0.1 * reach


def _send_frames(
    recording: rr.RecordingStream,
    root: str,
    scene: Scene,
    times: Sequence[rr.TimeColumn],
    q: Array,
) -> dict[str, str]:
    """Move the links, each an entity under its parent's. Returns link name -> entity path."""
    poses = scene.transforms(q)  # (T, n_links, 7)
    paths = {WORLD: root}
    for k, link in enumerate(scene.links):
        path = f"{paths[link.parent]}/{rr.escape_entity_path_part(link.name)}"
        columns = rr.Transform3D.columns(translation=poses[:, k, :3], quaternion=poses[:, k, 3:])
        recording.send_columns(path, times, columns)
        paths[link.name] = path
    return paths


def _send_trail(
    recording: rr.RecordingStream, times: Sequence[rr.TimeColumn], tip: Array, radius: float
) -> None:
    """Each stretch of the tip's way at the time it is gone, so that the past makes a trail."""
    before = tip[np.maximum(np.arange(len(tip)) - 1, 0)]
    style = rr.LineStrips3D.from_fields(colors=[TRAIL_RGB], radii=[radius])
    recording.log(f"{TRAIL}/actual", style, static=True)
    stretches = np.stack([before, tip], axis=1)  # (T, 2, 3)
    columns = rr.LineStrips3D.columns(strips=stretches)
    recording.send_columns(f"{TRAIL}/actual", times, columns)


def _log_shape(
    recording: rr.RecordingStream, link_path: str, geom: Geom, rgba: Rgba, scale: float = 1.0
) -> None:
    quaternion = rr.Quaternion(xyzw=geom.quat_xyzw)
    pose = rr.Transform3D(translation=geom.xyz, quaternion=quaternion, scale=scale)
    path = f"{link_path}/shapes/{rr.escape_entity_path_part(geom.name)}"
    recording.log(path, pose, _solid(geom, rgba), static=True)


def _solid(geom: Geom, rgba: Rgba) -> rr.AsComponents:
    a, b, c = geom.size
    match geom.shape:
        case "sphere":
            return rr.Ellipsoids3D(half_sizes=[(a, a, a)], colors=[rgba], fill_mode=SOLID)
        case "ellipsoid":
            return rr.Ellipsoids3D(half_sizes=[(a, b, c)], colors=[rgba], fill_mode=SOLID)
        case "box":
            return rr.Boxes3D(half_sizes=[(a, b, c)], colors=[rgba], fill_mode=SOLID)
        case "cylinder":
            return rr.Cylinders3D(radii=[a], lengths=[2 * b], colors=[rgba], fill_mode=SOLID)
        case "capsule":  # it starts at its origin; MuJoCo's is centred
            start = [(0.0, 0.0, -b)]
            return rr.Capsules3D(
                radii=[a], lengths=[2 * b], translations=start, colors=[rgba], fill_mode=SOLID
            )


def _pin(joint: Joint, radius: float) -> rr.AsComponents:
    """A joint as a pin along its axis, in the colour of its lines in the plots."""
    turn = np.cross([0.0, 0.0, 1.0], joint.axis)  # from z to the axis
    sine = float(np.linalg.norm(turn))
    if sine:
        turn *= math.atan2(sine, float(joint.axis[2])) / sine
    return rr.Cylinders3D(
        radii=[radius],
        lengths=[6 * radius],
        quaternions=[from_rotation_vector(turn)],
        colors=[joint_color(joint.index)],
        fill_mode=SOLID,
    )


def _rgba(geom: Geom) -> Rgba:
    red, green, blue, alpha = (round(255 * part) for part in geom.rgba)
    return red, green, blue, alpha


def _reach(scene: Scene) -> float:
    """How far a point of the robot can be from the origin (m), roughly."""
    frames = sum(float(np.linalg.norm(link.xyz)) for link in scene.links)
    shapes = [float(np.linalg.norm(geom.xyz)) + max(geom.size) for geom in scene.geoms]
    return frames + max(shapes, default=0.0)
