"""Desired joint angles, velocities and accelerations, sampled on the control grid."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dnnmso_mj.scenario import (
    ExpSinusoid,
    ExternalReference,
    Setpoint,
    Sinusoid,
    Waypoints,
    expand,
)
from dnnmso_mj.scenario import Reference as ReferenceSpec

Array = np.ndarray
Samples = tuple[Array, Array, Array]


class Reference:
    """q_ref(t) (rad), q̇_ref(t) (rad/s), q̈_ref(t) (rad/s²) of n joints.

    Args:
        spec: what the scenario asks for.
        n_joints: n.
        span: until when (s) one from outside is checked at once.

    Raises:
        ScenarioError, ExternalError: one from outside cannot be had, or is no reference.
    """

    def __init__(self, spec: ReferenceSpec, n_joints: int, span: float = 10.0) -> None:
        self._sample: Callable[[Array], Samples]
        match spec:
            case Sinusoid():
                self._sample = _sinusoid(spec, n_joints)
            case ExpSinusoid():
                self._sample = _exp_sinusoid(spec, n_joints)
            case Setpoint():
                self._sample = _setpoint(spec)
            case Waypoints():
                self._sample = _waypoints(spec)
            case ExternalReference():
                from dnnmso_mj.external.reference import external_reference

                self._sample = external_reference(spec, n_joints, span)

    def sample(self, t: Array) -> Samples:
        """q_ref, q̇_ref, q̈_ref, each (N, n), at times t (N,) in s."""
        return self._sample(t)


def _sinusoid(spec: Sinusoid, n: int) -> Callable[[Array], Samples]:
    amplitude, w = expand(spec.amplitude, n), expand(spec.frequency, n)
    phase, offset = expand(spec.phase, n), expand(spec.offset, n)

    def sample(t: Array) -> Samples:
        angle = t[:, None] * w + phase  # (N, n)
        sine = amplitude * np.sin(angle)
        return offset + sine, amplitude * w * np.cos(angle), -(w**2) * sine

    return sample


def _exp_sinusoid(spec: ExpSinusoid, n: int) -> Callable[[Array], Samples]:
    amplitude, w, phase = (expand(v, n) for v in (spec.amplitude, spec.frequency, spec.phase))

    def sample(t: Array) -> Samples:
        angle = t[:, None] * w  # (N, n)
        s, c = np.sin(angle), np.cos(angle)
        sine, cosine = np.sin(angle + phase), np.cos(angle + phase)
        size = amplitude * np.exp(-s)
        acceleration = (c**2 + s - 1) * sine - 2 * c * cosine
        return size * sine, size * w * (cosine - c * sine), size * w**2 * acceleration

    return sample


def minimum_jerk(s: Array) -> Samples:
    """Quintic blend p(s) = 10s³ − 15s⁴ + 6s⁵ for s in [0, 1], with p' and p''."""
    p = s**3 * (10 - 15 * s + 6 * s**2)
    dp = 30 * s**2 * (1 - s) ** 2
    ddp = 60 * s * (1 - s) * (1 - 2 * s)
    return p, dp, ddp


def _setpoint(spec: Setpoint) -> Callable[[Array], Samples]:
    start, goal = np.array(spec.start), np.array(spec.goal)
    move, T = goal - start, spec.blend_time

    def sample(t: Array) -> Samples:
        s = np.clip((t - spec.start_time) / T, 0.0, 1.0)[:, None]  # (N, 1)
        p, dp, ddp = minimum_jerk(s)
        return start + p * move, dp * move / T, ddp * move / T**2

    return sample


def _waypoints(spec: Waypoints) -> Callable[[Array], Samples]:
    from scipy.interpolate import make_interp_spline

    points = np.array(spec.points)  # (m, n)
    rest = np.zeros(points.shape[1])
    ends = [(1, rest), (2, rest)]
    spline = make_interp_spline(spec.times, points, k=5, bc_type=(ends, ends))
    velocity, acceleration = spline.derivative(1), spline.derivative(2)
    first, last = spec.times[0], spec.times[-1]

    def sample(t: Array) -> Samples:
        inside = np.clip(t, first, last)
        return spline(inside), velocity(inside), acceleration(inside)

    return sample
