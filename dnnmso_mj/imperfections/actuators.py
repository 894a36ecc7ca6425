"""What stands between the commanded torque and the arm.

    command → limit → rate limit → delay → first-order lag → arm

MuJoCo holds one torque through a period, so what acts is the exact mean over the period of what
the drive puts out meanwhile. A delay of d + φ periods, 0 ≤ φ < 1, puts out the command of d + 1
periods ago for the first φ of the period and that of d periods ago for the rest; the lag
T ẏ = u − y is solved exactly through both parts.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import compiled, copy, inner
from dnnmso_mj.scenario import Imperfections, expand

Array = np.ndarray

# Entries of a row of `Actuators.parts`.
DECAY, INPUT, STATE = range(3)


class Actuators(NamedTuple):
    """The drives, each joint with its own limits."""

    tau: Array  # (n,) N·m, what reaches the joints
    limit: Array  # (n,) N·m; infinite without one
    change: Array  # (n,) N·m, largest change in a period; infinite without one
    given: Array  # (n,) N·m, the last command after both limits
    past: Array  # (d + 2, n) N·m, commands as given, a ring
    lagged: Array  # (n,) N·m, output of the lag at the end of the last period
    parts: Array  # (2, 3): see `_parts`
    prompt: bool  # whether there is neither delay nor lag


def build_actuators(spec: Imperfections, n_joints: int, dt: float) -> Actuators:
    """The actuators of a scenario with the control period dt (s), at rest."""
    n = n_joints
    limit, rate = spec.torque_limit, spec.torque_rate
    whole, fraction = split(spec.actuator_delay / dt)
    return Actuators(
        tau=np.zeros(n),
        limit=np.full(n, np.inf) if limit is None else expand(limit, n),
        change=np.full(n, np.inf) if rate is None else expand(rate, n) * dt,
        given=np.zeros(n),
        past=np.zeros((whole + 2, n)),
        lagged=np.zeros(n),
        parts=_parts(fraction, spec.actuator_lag / dt),
        prompt=spec.actuator_delay == 0.0 and spec.actuator_lag == 0.0,
    )


def split(periods: float) -> tuple[int, float]:
    """Whole periods of a delay and the rest, which is 0 where only rounding makes it another."""
    whole = round(periods)
    if abs(periods - whole) < 1e-9 * max(1.0, periods):
        return whole, 0.0
    return math.floor(periods), periods - math.floor(periods)


def _parts(fraction: float, lag: float) -> Array:
    """Both parts of a period: how far the lag (in periods) decays, and the weights in its mean.

    y ← u + (y − u)·DECAY;  mean += u·INPUT + (y − u)·STATE, with y before that.
    """
    rows = []
    for length in (fraction, 1.0 - fraction):
        decayed = -math.expm1(-length / lag) if lag > 0.0 else 1.0
        rows.append([1.0 - decayed, length, lag * decayed])
    return np.array(rows)


def start_actuators(actuators: Actuators) -> None:
    """As before the first command: no torque, and none on its way."""
    for array in (actuators.tau, actuators.given, actuators.past, actuators.lagged):
        array[:] = 0.0


@inner
def actuate(actuators: Actuators, tau_cmd: Array, k: int) -> bool:
    """Pass tick k's command (n,) N·m on; whether a limit changed it."""
    saturated = _limit(tau_cmd, actuators.limit, actuators.change, actuators.given)
    if actuators.prompt:
        copy(actuators.given, actuators.tau)
    else:
        _respond(
            k, actuators.given, actuators.past, actuators.lagged, actuators.parts, actuators.tau
        )
    return saturated


@compiled
def _limit(tau_cmd: Array, limit: Array, change: Array, given: Array) -> bool:
    """Clamp to ±limit, then to `given` ± change; N.B. what is not a number stays so."""
    saturated = False
    for i in range(tau_cmd.size):
        tau = tau_cmd[i]
        if abs(tau) > limit[i]:
            tau = math.copysign(limit[i], tau)
            saturated = True
        if abs(tau - given[i]) > change[i]:
            tau = given[i] + math.copysign(change[i], tau - given[i])
            saturated = True
        given[i] = tau
    return saturated


@compiled
def _respond(k: int, given: Array, past: Array, lagged: Array, parts: Array, tau: Array) -> None:
    """Delay and lag of tick k's command: its period's mean into `tau`."""
    size = len(past)
    whole = size - 2
    for i in range(given.size):
        past[k % size, i] = given[i]
        y, mean = lagged[i], 0.0
        for part in range(2):
            u = past[(k - whole - 1 + part) % size, i]
            mean += u * parts[part, INPUT] + (y - u) * parts[part, STATE]
            y = u + (y - u) * parts[part, DECAY]
        tau[i], lagged[i] = mean, y
