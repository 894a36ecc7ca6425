"""Trajectories that were never seen: some inside the visited region, some beyond it.

They follow from the region alone, so that all controllers and seeds of an audit are asked the same.
With c the mean of the visited angles, h half the range of each, v the largest speed of each joint,
and w = min v/h:

    inside    smaller    the quarter-turn motion of a circle, at 0.8 w
              reversed   the same the other way round
              in phase   all joints together, at 0.8 w
              lissajous  joints at frequencies from 0.5 w to 0.9 w
              tour       a quintic spline through four poses, at rest at both ends
              move       one minimum-jerk move between two visited poses, and the hold after it
    outside   larger     a circle of 1.6 h, at 0.5 w: angles beyond the visited ones
              faster     all joints together at 2 w/a: velocities twice the visited ones
              elsewhere  a circle of 0.5 h about c + 1.7 h

Each amplitude inside is the largest of 0.7 h, 0.65 h, … for which every state of the reference is
inside; a trajectory for which there is none (of a region that is a mere line, say) is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dnnmso_mj.audit.region import Region
from dnnmso_mj.reference import Reference
from dnnmso_mj.scenario import Reference as ReferenceSpec
from dnnmso_mj.scenario import Setpoint, Sinusoid, Waypoints

Array = np.ndarray
Family = Callable[[Region, float], ReferenceSpec]

SETTLING = 2.0  # s, left out of the error
SPAN = 12.0  # s, with it
SCALES = np.arange(0.7, 0.15, -0.05)
SAMPLES = 240  # states of a reference that are looked at
MINIMUM_JERK_PEAK = 1.875  # peak over mean speed


@dataclass(frozen=True)
class Unseen:
    """A trajectory that was never seen.

    Args:
        name: see the list above.
        reference: what to follow for `SPAN` seconds.
        inside: whether all of it is inside the visited region; else most of it is outside.
    """

    name: str
    reference: ReferenceSpec
    inside: bool


def unseen_trajectories(region: Region) -> tuple[Unseen, ...]:
    """All of the list above that this region allows."""
    return (*_inside(region), *_outside(region))


def reference_states(reference: ReferenceSpec, n_joints: int, times: Array) -> Array:
    """x_ref (N, 2n) at times (N,) s."""
    q_ref, qd_ref, _ = Reference(reference, n_joints).sample(times)
    return np.hstack([q_ref, qd_ref])


def _inside(region: Region) -> Iterator[Unseen]:
    families: dict[str, Family] = {
        "smaller": lambda region, a: _circle(region, a, 0.8),
        "reversed": lambda region, a: _circle(region, a, 0.8, turn=-1.0),
        "in phase": lambda region, a: _circle(region, a, 0.8, turn=0.0),
        "lissajous": _lissajous,
        "tour": _tour,
        "move": _move,
    }
    times = np.linspace(0.0, SPAN, SAMPLES)
    for name, family in families.items():
        for scale in SCALES:
            reference = family(region, float(scale))
            states = reference_states(reference, region.n_joints, times)
            if region.contains(states).all():
                yield Unseen(name, reference, inside=True)
                break


def _outside(region: Region) -> Iterator[Unseen]:
    beyond = region.middle + 1.7 * region.half
    yield Unseen("larger", _circle(region, 1.6, 0.5), inside=False)
    yield Unseen("faster", _circle(region, 0.7, 2.0 / 0.7, turn=0.0), inside=False)
    yield Unseen("elsewhere", _circle(region, 0.5, 0.8, centre=beyond), inside=False)


def _circle(
    region: Region, a: float, pace: float, *, turn: float = 1.0, centre: Array | None = None
) -> Sinusoid:
    """Joint i at offset + a h_i sin(pace w t + turn i π/2)."""
    n = region.n_joints
    offset = (region.middle if centre is None else centre)[:n]
    return Sinusoid(
        kind="sinusoid",
        amplitude=tuple((a * region.half[:n]).tolist()),
        frequency=(pace * _frequency(region),),
        phase=tuple((turn * np.pi / 2 * np.arange(n)).tolist()),
        offset=tuple(offset.tolist()),
    )


def _lissajous(region: Region, a: float) -> Sinusoid:
    frequencies = _frequency(region) * np.linspace(0.5, 0.9, region.n_joints)
    return _circle(region, a, 1.0).model_copy(update={"frequency": tuple(frequencies.tolist())})


def _tour(region: Region, a: float) -> Waypoints:
    poses = _poses(region, a, (0.0, 0.55, 0.2, 0.8))
    legs = [2.0 * _least_time(region, goal - start) for start, goal in pairwise(poses)]
    times = np.concatenate([[0.0], np.cumsum(legs)])
    return Waypoints(
        kind="waypoints",
        times=tuple(times.tolist()),
        points=tuple(tuple(pose) for pose in poses.tolist()),
    )


def _move(region: Region, a: float) -> Setpoint:
    start, goal = _poses(region, a, (0.1, 0.6))
    least = MINIMUM_JERK_PEAK * _least_time(region, goal - start)
    return Setpoint(
        kind="setpoint",
        start=tuple(start.tolist()),
        goal=tuple(goal.tolist()),
        start_time=SETTLING,
        blend_time=1.05 * least,
    )


def _poses(region: Region, a: float, where: tuple[float, ...]) -> Array:
    """Visited angles at these fractions of the visit, drawn towards the middle by a: (m, n) rad."""
    n, last = region.n_joints, len(region.corners) - 1
    chosen = region.corners[[round(part * last) for part in where]]
    visited = region.centre[:n] + region.half[:n] * chosen
    poses: Array = (1.0 - a) * region.middle[:n] + a * visited
    return poses


def _least_time(region: Region, move: Array) -> float:
    """How long a move (n,) rad takes at the visited velocities (s)."""
    return max(float((np.abs(move) / region.half[region.n_joints :]).max()), 0.5)


def _frequency(region: Region) -> float:
    """w = min v/h (rad/s)."""
    n = region.n_joints
    return float((region.half[n:] / region.half[:n]).min())
