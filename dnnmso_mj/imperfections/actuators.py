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

from dnnmso_mj.compiling import compiled, inner
from dnnmso_mj.scenario import Imperfections, expand

Array = np.ndarray

# Entries of a row of `Actuators.parts`.
DECAY, INPUT, STATE = range(3)
# Rows of `Actuators.held`.
GIVEN, LAGGED = range(2)

ROUNDING = 1e-12  # of a mean of two torques, in parts of it; a few times more than it can be


class Actuators(NamedTuple):
    """The drives, each joint with its own limits."""

    tau: Array  # (n,) N·m, what reaches the joints
    limits: Array  # (2, n) N·m: of a torque, of its change in a period; infinite without one
    held: Array  # (2, n) N·m: the last command after both limits; the lag's output
    past: Array  # (d + 2, n) N·m, commands after both limits, a ring
    parts: Array  # (2, 3): see `_parts`
    prompt: bool  # whether there is neither delay nor lag


def build_actuators(spec: Imperfections, n_joints: int, dt: float) -> Actuators:
    """The actuators of a scenario with the control period dt (s), at rest."""
    n = n_joints
    limit, rate = spec.torque_limit, spec.torque_rate
    most = np.full(n, np.inf) if limit is None else expand(limit, n)
    change = np.full(n, np.inf) if rate is None else expand(rate, n) * dt
    whole, fraction = split(spec.actuator_delay / dt)
    return Actuators(
        tau=np.zeros(n),
        limits=np.array([most, change]),
        held=np.zeros((2, n)),
        past=np.zeros((whole + 2, n)),
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
    for array in (actuators.tau, actuators.held, actuators.past):
        array[:] = 0.0


@inner
def actuate(actuators: Actuators, tau_cmd: Array, k: int) -> bool:
    """Pass tick k's command (n,) N·m on; whether a limit changed it."""
    saturated = _limit(tau_cmd, actuators.limits, actuators.held, actuators.tau)
    if not actuators.prompt:
        _respond(
            k, actuators.limits, actuators.held, actuators.past, actuators.parts, actuators.tau
        )
    return saturated


@compiled
def _limit(tau_cmd: Array, limits: Array, held: Array, tau: Array) -> bool:
    """Clamp the torque, then its change; N.B. what is not a number stays so."""
    saturated = False
    for i in range(tau_cmd.size):
        most, change = limits[0, i], limits[1, i]
        wanted = tau_cmd[i]
        if abs(wanted) > most:
            wanted = math.copysign(most, wanted)
            saturated = True
        if abs(wanted - held[GIVEN, i]) > change:
            wanted = held[GIVEN, i] + math.copysign(change, wanted - held[GIVEN, i])
            saturated = True
        tau[i] = held[GIVEN, i] = wanted
    return saturated


@compiled
def _respond(k: int, limits: Array, held: Array, past: Array, parts: Array, tau: Array) -> None:
    """Delay and lag: from tick k's command in `tau` to its period's mean.

    A mean of torques within the limit is within it, but for rounding, which is cut off; what is
    further out, or no number, was not made here and must be seen.
    """
    size = len(past)
    whole = size - 2
    for i in range(tau.size):
        past[k % size, i] = tau[i]
        y, mean = held[LAGGED, i], 0.0
        for part in range(2):
            u = past[(k - whole - 1 + part) % size, i]
            mean += u * parts[part, INPUT] + (y - u) * parts[part, STATE]
            y = u + (y - u) * parts[part, DECAY]
        most = limits[0, i]
        if most < abs(mean) < most * (1.0 + ROUNDING):
            mean = math.copysign(most, mean)
        tau[i], held[LAGGED, i] = mean, y
