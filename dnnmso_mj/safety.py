"""The safe stop: a joint that passes a limit of the scenario takes the arm from its controller.

    trips where q < q_min, q > q_max or |q̇| > qd_max, of the true state;
    τ = −stiffness (q − q_stop) − damping q̇, q_stop that of the first tick; or none

It stands for limit switches and a brake of their own at the joints, as on a real arm: what is wrong
with the controller's sensors must not disarm it. Its torque passes the drives as any other does,
with their limits, delay and lag. The stop is over when the arm has stood still for a while, or
after a time, and the run is then.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import compiled, inner
from dnnmso_mj.scenario import Safety as SafetySpec
from dnnmso_mj.scenario import expand
from dnnmso_mj.trace import Array

# Rows of `Safety.limits`: what is allowed, the brake, and the state in which it took hold.
Q_MIN, Q_MAX, QD_MAX, STIFFNESS, DAMPING, Q_STOP, QD_STOP = range(7)

FREE, STOPPING, STOPPED = range(3)  # the last tick of a stop is STOPPED

STANDS_FOR = 0.1  # s; an arm that turns round is at rest for less


class Safety(NamedTuple):
    """The safe stop as a tick sees it."""

    limits: Array  # (7, n), see above
    ticks: Array  # (2,) int64: the stop's first tick + 1, or 0; how many the arm has been at rest
    ends: Array  # (2,) int64: after how many ticks of the stop, or at rest, the run ends
    standstill: float  # rad/s
    guards: bool  # whether there is any limit


def build_safety(spec: SafetySpec, n_joints: int, dt: float) -> Safety:
    """The safe stop of a scenario with the control period dt (s), not tripped."""
    n = n_joints
    brakes = spec.response == "brake"
    limits = np.array(
        [
            expand((-np.inf,) if spec.q_min is None else spec.q_min, n),
            expand((np.inf,) if spec.q_max is None else spec.q_max, n),
            expand((np.inf,) if spec.qd_max is None else spec.qd_max, n),
            expand(spec.stiffness, n) * brakes,
            expand(spec.damping, n) * brakes,
            *np.zeros((2, n)),
        ]
    )
    ends = [max(1, round(time / dt)) for time in (spec.stop_time, STANDS_FOR)]
    ticks = np.zeros(2, np.int64)
    return Safety(limits, ticks, np.array(ends), spec.standstill, spec.guards)


def start_safety(safety: Safety) -> None:
    """Not tripped."""
    safety.ticks[:] = 0
    safety.limits[Q_STOP:] = 0.0


@inner
def guard(safety: Safety, x: Array, k: int, tau: Array) -> int:
    """FREE, STOPPING or STOPPED: whether the stop acts in tick k, of an arm at x (2n,).

    Its torque (n,) N·m goes into `tau`; without limits nothing is done.
    """
    if not safety.guards:
        return FREE
    return _guard(safety.limits, safety.ticks, safety.ends, safety.standstill, x, k, tau)


@compiled
def _guard(
    limits: Array, ticks: Array, ends: Array, standstill: float, x: Array, k: int, tau: Array
) -> int:
    n = tau.size
    if ticks[0] == 0:
        passed = False
        for j in range(n):
            within = limits[Q_MIN, j] <= x[j] <= limits[Q_MAX, j]
            passed = passed or not within or abs(x[n + j]) > limits[QD_MAX, j]
        if not passed:
            return FREE
        ticks[0] = k + 1
        for j in range(n):
            limits[Q_STOP, j], limits[QD_STOP, j] = x[j], x[n + j]
    ticks[1] += 1
    for j in range(n):
        if abs(x[n + j]) > standstill:
            ticks[1] = 0
        bend = x[j] - limits[Q_STOP, j]
        tau[j] = -limits[STIFFNESS, j] * bend - limits[DAMPING, j] * x[n + j]
    over = k + 2 - ticks[0] >= ends[0] or ticks[1] >= ends[1]
    return STOPPED if over else STOPPING


def what_tripped(spec: SafetySpec, safety: Safety) -> str:
    """In words, a joint that was past a limit, its value and the limit; "" before any was.

    Args:
        spec: the limits.
        safety: made of it.
    """
    if safety.ticks[0] == 0:
        return ""
    q, qd = safety.limits[Q_STOP], safety.limits[QD_STOP]
    n = q.size
    for name, values, unit, limit, sign in (
        ("q_min", q, "rad", spec.q_min, -1.0),
        ("q_max", q, "rad", spec.q_max, 1.0),
        ("qd_max", np.abs(qd), "rad/s", spec.qd_max, 1.0),
    ):
        if limit is None:
            continue
        beyond = np.flatnonzero(sign * values > sign * expand(limit, n))
        if beyond.size:
            j = int(beyond[0])
            what = "|qd|" if name == "qd_max" else "q"
            where = "below" if sign < 0 else "above"
            allowed = f"{name} = {expand(limit, n)[j]:g} {unit}"
            return f"{what} of joint {j + 1} = {values[j]:.6g} {unit}, {where} {allowed}"
    return ""
