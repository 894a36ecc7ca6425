"""The arm in Rerun's 3-D: links, joints, the trail of its tip, and the desired arm as a ghost."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import rerun as rr

from dnnmso_mj.reference import Reference
from dnnmso_mj.rotations import from_rotation_vector
from dnnmso_mj.scenario import ExternalReference, Scenario
from dnnmso_mj.scene import WORLD, Geom, Joint, Scene
from dnnmso_mj.viewer.blueprint import ARM, DESIRED, TRAIL
from dnnmso_mj.viewer.look import Look, Point
from dnnmso_mj.viewer.plot import Rgb, joint_color
from dnnmso_mj.viewer.stamps import stamps

Array = np.ndarray
Rgba = tuple[int, int, int, int]

POSE_PERIOD = 0.01  # s, at least, between two poses of the arm: eyes need no more
GHOST_RGBA: Rgba = (255, 255, 255, 60)
GHOST_SCALE = 0.9  # so that it vanishes in the arm where the arm is where it should be
PATH_RGB = (255, 255, 255)
TRAIL_RGB = (255, 220, 90)
SOLID = rr.components.FillMode.Solid
_PATH_POINTS = 10_000


class ArmPicture:
    """A run's arm, drawn a stretch of ticks at a time.

    Args:
        recording: where to.
        scenario: the experiment.
        scene: the robot.
        root: what the paths of all entities begin with.
        look: colour and place of the arm.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        scenario: Scenario,
        scene: Scene,
        root: str,
        look: Look,
    ) -> None:
        self._recording = recording
        self._scene = scene
        self._look = look
        self._reach = scene.reach
        self._stride = _stride(scenario)
        self._trail, self._desired_trail = f"{root}{TRAIL}/actual", f"{root}{TRAIL}/desired"
        self._roots = [root + name for name in (ARM, DESIRED, TRAIL)]
        self._frames = _frames(scene, self._roots[0])
        self._ghost_frames = _frames(scene, self._roots[1])
        self._path = _desired_path(scenario, scene)
        self._last: dict[str, Array] = {}  # where each trail has come to

    def begin(self) -> None:
        """What does not move: shapes, pins, the desired path, and the style of the trail."""
        recording, scene, reach = self._recording, self._scene, self._reach
        if any(self._look.offset):
            for root in self._roots:
                recording.log(root, rr.Transform3D(translation=self._look.offset), static=True)
        for geom in scene.geoms:
            rgba = _rgba(geom, self._look.color)
            _log_shape(recording, self._frames[geom.body], geom, rgba)
            if geom.body != WORLD and self._look.ghost:
                place = self._ghost_frames[geom.body]
                _log_shape(recording, place, geom, GHOST_RGBA, GHOST_SCALE)
        for link in scene.links:
            if link.joint:
                pin = _pin(link.joint, 0.02 * reach)
                recording.log(f"{self._frames[link.name]}/shapes/pin", pin, static=True)
        radius = 0.004 * reach
        # Thinner than the trail, which so covers it where the tip has kept to it.
        style = rr.LineStrips3D.from_fields(colors=[PATH_RGB], radii=[0.6 * radius])
        recording.log(self._desired_trail, style, static=True)
        if self._look.ghost and self._path is not None:
            path = rr.LineStrips3D.from_fields(strips=[self._path])
            recording.log(self._desired_trail, path, static=True)
        color = self._look.color or TRAIL_RGB
        style = rr.LineStrips3D.from_fields(colors=[color], radii=[radius])
        recording.log(self._trail, style, static=True)

    def send(self, t: Array, ticks: Array, q: Array, q_ref: Array) -> None:
        """Move the arm, and draw its trail on.

        Args:
            t, ticks: times (s) of the stretch and their numbers in the run, (N,).
            q, q_ref: joint angles and desired ones (rad), shape (N, n).
        """
        finite = np.isfinite(q).all(axis=1)  # a diverged arm is nowhere to be drawn
        drawn = np.flatnonzero((ticks % self._stride == 0) & finite)
        if not len(drawn):
            return
        times = stamps(t[drawn], ticks[drawn])
        self._send_frames(self._frames, times, q[drawn])
        if self._look.ghost:
            self._send_frames(self._ghost_frames, times, q_ref[drawn])
        self._draw_on(self._trail, times, q[drawn])
        if self._look.ghost and self._path is None:
            self._draw_on(self._desired_trail, times, q_ref[drawn])

    def _draw_on(self, trail: str, times: Sequence[rr.TimeColumn], q: Array) -> None:
        """Each stretch of a tip's way at the time it is gone, so that the past makes a trail."""
        tip = self._scene.tip(q)
        before = np.roll(tip, 1, axis=0)
        before[0] = self._last.get(trail, tip[0])
        self._last[trail] = tip[-1]
        stretches = np.stack([before, tip], axis=1)  # (m, 2, 3)
        self._recording.send_columns(trail, times, rr.LineStrips3D.columns(strips=stretches))

    def _send_frames(
        self, frames: dict[str, str], times: Sequence[rr.TimeColumn], q: Array
    ) -> None:
        poses = self._scene.transforms(q)  # (m, n_links, 7)
        for k, link in enumerate(self._scene.links):
            xyz, quaternion = poses[:, k, :3], poses[:, k, 3:]
            columns = rr.Transform3D.columns(translation=xyz, quaternion=quaternion)
            self._recording.send_columns(frames[link.name], times, columns)


def stage(scenario: Scenario, scene: Scene) -> tuple[Point, float]:
    """Centre and half size (m) of what a camera must show, known before a run begins."""
    start = scene.tip(np.array([scenario.initial.q]))
    path = _desired_path(scenario, scene)
    if path is None:
        return (0.0, 0.0, 0.0), scene.reach
    points = np.concatenate([np.zeros((1, 3)), start, path])
    low, high = points.min(axis=0), points.max(axis=0)
    x, y, z = map(float, (low + high) / 2)
    return (x, y, z), max(float((high - low).max()) / 2, 0.4 * scene.reach) + 0.1 * scene.reach


def _stride(scenario: Scenario) -> int:
    """Ticks from one pose to the next."""
    return max(1, math.ceil(POSE_PERIOD / scenario.dt - 1e-9))


def _desired_path(scenario: Scenario, scene: Scene) -> Array | None:
    """Where the tip should be over the run, (m, 3) m; None of a reference from outside.

    To look at a run calls no code from outside.
    """
    if isinstance(scenario.reference, ExternalReference):
        return None
    stride = max(_stride(scenario), math.ceil(scenario.n_ticks / _PATH_POINTS))
    t = np.arange(0, scenario.n_ticks, stride) * scenario.dt
    q_ref, _, _ = Reference(scenario.reference, scenario.n_joints).sample(t)
    return scene.tip(q_ref)


def _frames(scene: Scene, root: str) -> dict[str, str]:
    """Link name -> entity path, each under its parent's."""
    paths = {WORLD: root}
    for link in scene.links:
        paths[link.name] = f"{paths[link.parent]}/{rr.escape_entity_path_part(link.name)}"
    return paths


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


def _rgba(geom: Geom, color: Rgb | None) -> Rgba:
    red, green, blue, alpha = (round(255 * part) for part in geom.rgba)
    return (*color, alpha) if color else (red, green, blue, alpha)
