"""One tick of the closed loop around a controller's update, compiled.

    begin_tick      wait for t_k (in real time), read the sensors and the reference
    update          the controller commands and learns
    end_tick        actuators, true dynamics, the row for the log, one step of MuJoCo

Tick k is at t_k = k·dt: time is computed, never accumulated. `closed_loop` puts a controller's
compiled update between the two halves; `simulate` calls them around one that is not compiled.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from types import FunctionType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dnnmso_mj.clock import now_ns, sleep_until
from dnnmso_mj.compiling import compiled, copy, inner
from dnnmso_mj.imperfections.actuators import GIVEN, Actuators, actuate
from dnnmso_mj.imperfections.loads import BEFORE, Loads, load
from dnnmso_mj.imperfections.sensors import Sensors, sense
from dnnmso_mj.inversion import solve_spd
from dnnmso_mj.plant import Nominal, PlantView, inertia, integrate, solve_inertia
from dnnmso_mj.safety import FREE, STOPPED, Safety, guard
from dnnmso_mj.theory import TrackingBounds, begin_period, end_period

if TYPE_CHECKING:
    from dnnmso_mj.controllers import Command, Inputs

Array = np.ndarray
Update = Callable[[Any, "Inputs"], None]
Loop = Callable[["World", Any, int, int], int]

# rad, rad/s: no arm is there and comes back.
DIVERGED_ABOVE = 1e3
MUJOCO_ZEROES_ABOVE = 1e9  # N·m; from 1e10 on MuJoCo drops a torque with a mere warning
QDD_ABOVE = 1e10  # rad/s²; MuJoCo's own mark of a bad one, from where a step may overflow

# Why a loop ended: values of the slot STATUS.
RUNNING, TAU_NOT_FINITE, TAU_TOO_LARGE, ROW_NOT_FINITE, OUT_OF_RANGE = range(5)
STATE_NOT_FINITE, READING_NOT_FINITE, LOAD_TOO_LARGE, SAFELY_STOPPED = range(5, 9)
RECORDED = (OUT_OF_RANGE, SAFELY_STOPPED)  # whose last tick has a row

# Slots of `World.counts`.
STATUS, ROWS, CHUNK_START, START_NS, CONTROLLED, MISSED, STALLS, TOOK_NS = range(8)
N_COUNTS = 8

# What acts on a joint whose command came too late.
HOLD, ZERO, DAMPED = range(3)


class Pace(NamedTuple):
    """How ticks follow the wall clock."""

    period_ns: int  # 0: not at all, as fast as can be
    watchdog: int  # HOLD, ZERO or DAMPED
    damping: float  # N·m·s/rad, of DAMPED
    stalls: Array  # (m, 2) int64: ticks in order and ns, where the controller is made to hang


class World(NamedTuple):
    """All that a tick touches but the controller; arrays, overwritten in place."""

    plant: PlantView
    sensors: Sensors
    actuators: Actuators
    loads: Loads
    safety: Safety
    bounds: TrackingBounds
    pace: Pace
    reference: Array  # (chunk, 3n): q_ref, q̇_ref and q̈_ref of each tick,
    ahead: Array  # and what the controller reads of it, some time ahead of the tick
    x: Array  # (2n,) the true state
    x_ref: Array  # (2n,)
    xd_ref: Array  # (2n,)
    inputs: Inputs  # what the controller is told
    e_track: Array  # (2n,)
    f_true: Array  # (2n,)
    f_err: Array  # (2n,) what the closed loop feels of f̃, saturation included
    tau: Array  # (n,) applied in the last period
    qdd: Array  # (n,) scratch
    L: Array  # (n, n) scratch
    nominal: Nominal  # what the controller takes for the robot: B₂ = M(q)⁻¹,
    b: float  # or b·I where this is positive
    inverts: bool  # whether the controller has worked out B τ for its command
    rows: Array  # (block, width): `trace.StepLayout`
    counts: Array  # int64, see above
    late_ns: Array  # (1,) int64, of this tick's wake-up
    timespec: Array  # (2,) int64 scratch
    dt: float


def closed_loop(update: Update) -> Loop:
    """Compile the whole loop around a controller's `update(parts, inputs)`.

    `update` is an `inner` function, and its parts have a field `command`. The loop takes (world,
    parts, first, count), runs ticks first to first + count, and returns how many were done.

    N.B. each loop is `_run_ticks` with an `update` of its own for that global name, and a name of
    its own on disk: compiled code with a function in a closure could not be kept there.
    """
    names = globals() | {"update": update}
    loop = FunctionType(_run_ticks.__code__, names, "run_ticks")
    loop.__qualname__ = f"run_ticks.{update.__module__}"
    return compiled(loop)


def _run_ticks(world: World, parts: Any, first: int, count: int) -> int:
    for k in range(first, first + count):
        if begin_tick(world, k):
            began = now_ns(world.timespec)
            update(parts, world.inputs)
            world.counts[TOOK_NS] = now_ns(world.timespec) - began
        if end_tick(world, parts.command, k):
            return k + 1 - first
    return count


def update(parts: Any, inputs: Inputs) -> None:
    """What `closed_loop` puts a controller's law in the place of."""


@inner
def begin_tick(world: World, k: int) -> bool:
    """Wait for tick k, read sensors and reference.

    False where real time has passed all of it, or where a state or a reading is not finite: neither
    the controller nor MuJoCo is to see that.
    """
    world.counts[TOOK_NS] = 0
    world.late_ns[0] = 0
    in_time = world.pace.period_ns == 0 or _wait(world, k)
    world.counts[CONTROLLED] = 1 if in_time else 0
    n, plant, inputs = world.tau.size, world.plant, world.inputs
    i = k - world.counts[CHUNK_START]
    for j in range(n):
        world.x[j], world.x[n + j] = plant.q[j], plant.qd[j]
        inputs.tau[j] = world.tau[j]
    sense(world.sensors, world.x, k, i, inputs.x)
    there = told = True
    for j in range(2 * n):
        world.x_ref[j], world.xd_ref[j] = world.reference[i, j], world.reference[i, n + j]
        inputs.x_ref[j], inputs.xd_ref[j] = world.ahead[i, j], world.ahead[i, n + j]
        world.e_track[j] = world.x[j] - world.x_ref[j]
        there, told = there and math.isfinite(world.x[j]), told and math.isfinite(inputs.x[j])
    if not (there and told):
        world.counts[STATUS] = READING_NOT_FINITE if there else STATE_NOT_FINITE
    return in_time and there and told


@inner
def _wait(world: World, k: int) -> bool:
    """Wait for the wall-clock time of tick k; whether there is still time to control it."""
    period = world.pace.period_ns
    due = world.counts[START_NS] + k * period
    now = now_ns(world.timespec)
    if now < due:
        now = sleep_until(due, world.timespec)
    world.late_ns[0] = now - due
    return bool(now < due + period)


@inner
def end_tick(world: World, command: Command, k: int) -> bool:
    """Apply the command, record tick k and step the arm; True where the run must end."""
    if world.counts[STATUS] != RUNNING:
        return True
    missed = world.pace.period_ns > 0 and _too_late(world, k)
    world.counts[MISSED] = 1 if missed else 0
    stop = guard(world.safety, world.x, k, world.qdd)
    saturated = actuate(world.actuators, _wanted(world, command, missed, stop), k)
    tau = world.actuators.tau
    if not _drive(world, tau):
        return True
    if k > 0:
        _end_period(world, tau)
    _true_dynamics(world, command, tau, saturated or missed or stop != FREE)
    if not _record(world, command, k, saturated, missed):
        return True
    if _is_out_of_range(world, command):
        world.counts[STATUS] = OUT_OF_RANGE
        return True
    if stop == STOPPED:
        world.counts[STATUS] = SAFELY_STOPPED
        return True
    qdd_ref = world.xd_ref[tau.size :]
    begin_period(world.bounds, world.f_err, world.e_track, world.plant.qacc, qdd_ref)
    copy(tau, world.tau)
    integrate(world.plant)
    return False


@inner
def _wanted(world: World, command: Command, missed: bool, stop: int) -> Array:
    """The torque (n,) N·m that the drives are given; that of the safe stop is in `qdd`."""
    if stop != FREE:
        return world.qdd
    if missed:
        return _watchdog(world)
    return command.tau


@inner
def _drive(world: World, tau: Array) -> bool:
    """True q̈ under τ (n,) N·m and all loads; False where MuJoCo may not be given one of them."""
    status, moved = RUNNING, False
    q, qd = world.plant.q, world.plant.qd
    for j in range(tau.size):
        if not math.isfinite(tau[j]):
            status = TAU_NOT_FINITE
        elif abs(tau[j]) > MUJOCO_ZEROES_ABOVE and status == RUNNING:
            status = TAU_TOO_LARGE
        if not (math.isfinite(q[j]) and math.isfinite(qd[j])):
            moved = True
    if moved:
        status = STATE_NOT_FINITE  # changed from outside since the tick began
    if status == RUNNING and not load(world.loads, world.plant, tau, world.dt, MUJOCO_ZEROES_ABOVE):
        status = LOAD_TOO_LARGE
    world.counts[STATUS] = status
    return status == RUNNING


@inner
def _record(world: World, command: Command, k: int, saturated: bool, missed: bool) -> bool:
    """Tick k as the next row; False where it is not finite."""
    row = world.rows[world.counts[ROWS]]
    fill(world, command, k, saturated, missed, row)
    for value in row:
        if not math.isfinite(value):
            world.counts[STATUS] = ROW_NOT_FINITE
            return False
    world.counts[ROWS] += 1
    return True


@inner
def _is_out_of_range(world: World, command: Command) -> bool:
    """Whether the arm, or what the controller takes for it, is where no arm is."""
    far = False
    for j in range(world.x.size):
        if max(abs(world.x[j]), abs(command.x_hat[j])) > DIVERGED_ABOVE:
            far = True
    for j in range(world.tau.size):
        if abs(world.plant.qacc[j]) > QDD_ABOVE:
            far = True
    return far


@inner
def _too_late(world: World, k: int) -> bool:
    """Whether tick k has no command in time; the hangs that a scenario asks for happen here."""
    pace = world.pace
    if world.counts[CONTROLLED] == 0:
        return True
    while world.counts[STALLS] < len(pace.stalls) and pace.stalls[world.counts[STALLS], 0] <= k:
        hang = pace.stalls[world.counts[STALLS], 1]
        sleep_until(now_ns(world.timespec) + hang, world.timespec)
        world.counts[TOOK_NS] += hang
        world.counts[STALLS] += 1
    due = world.counts[START_NS] + k * pace.period_ns
    return bool(now_ns(world.timespec) > due + pace.period_ns)


@inner
def _watchdog(world: World) -> Array:
    """The torque (n,) N·m that acts where none was commanded in time."""
    n, tau = world.tau.size, world.qdd
    for j in range(n):
        if world.pace.watchdog == HOLD:
            tau[j] = world.actuators.held[GIVEN, j]
        elif world.pace.watchdog == ZERO:
            tau[j] = 0.0
        else:
            tau[j] = -world.pace.damping * world.inputs.x[n + j]
    return tau


@inner
def _end_period(world: World, tau: Array) -> None:
    """The period before tick k ended with q̈ under the torques that were held until now."""
    n, loads = tau.size, world.loads
    change = world.f_true[:n]
    for j in range(n):
        change[j] = (world.tau[j] - tau[j]) + (loads.held[BEFORE, j] - loads.torque[j])
    solve_inertia(world.plant, change, world.qdd)
    for j in range(n):
        world.qdd[j] += world.plant.qacc[j]
    end_period(world.bounds, world.e_track, world.qdd, world.xd_ref[n:])


@inner
def _effect(world: World, tau: Array, out: Array) -> None:
    """B₂ τ (n,) for the B₂ that the controller believes, at the present state."""
    if world.b > 0.0:
        for j in range(tau.size):
            out[j] = world.b * tau[j]
    else:
        inertia(world.nominal, world.x[: tau.size])
        solve_spd(world.nominal.M, tau, out, world.L)


@inner
def _true_dynamics(world: World, command: Command, tau: Array, substituted: bool) -> None:
    """f_true = Ẋ − B τ, and what the closed loop feels of it, f_err = Ẋ − B τ_cmd − f̂.

    B τ is the command's own where that acts and where its B is that of the true state.
    """
    n = tau.size
    other = substituted or not (world.actuators.prompt and world.sensors.perfect)
    if not world.inverts:
        _effect(world, command.tau, command.Bu[n:])
    for j in range(n):
        world.f_true[j], world.f_true[n + j] = world.x[n + j], world.plant.qacc[j]
    for j in range(2 * n):
        world.f_err[j] = world.f_true[j] - command.Bu[j] - command.f_hat[j]
    if other:
        _effect(world, tau, world.qdd)
        for j in range(n):
            world.f_true[n + j] -= world.qdd[j]
    else:
        for j in range(2 * n):
            world.f_true[j] -= command.Bu[j]


@inner
def fill(world: World, command: Command, k: int, saturated: bool, missed: bool, row: Array) -> None:
    """Tick k as a row, in the order of `StepLayout.widths`."""
    n, monitors = world.tau.size, command.monitors
    states, torques = 2 * n, 1 + 6 * n
    learned, layers = torques + 2 * n, monitors.weight_norm.size
    row[0] = k * world.dt
    lyapunov = 0.0
    for j in range(states):
        row[1 + j] = world.x[j]
        row[1 + states + j] = world.inputs.x[j]
        row[1 + 2 * states + j] = world.x_ref[j]
        row[learned + j] = command.x_hat[j]
        row[learned + states + j] = command.f_hat[j]
        row[learned + 2 * states + j] = world.f_true[j]
        row[learned + 3 * states + j] = command.e_obs[j]
        lyapunov += world.e_track[j] ** 2
    for j in range(n):
        row[torques + j] = command.tau[j]
        row[torques + n + j] = world.actuators.tau[j]
    at = learned + 4 * states
    for j in range(layers):
        row[at + j] = monitors.weight_norm[j]
        row[at + layers + j] = monitors.update_ratio[j]
        row[at + 2 * layers + j] = monitors.eta_bound[j]
        row[at + 3 * layers + j] = monitors.gradient_change[j]
    at += 4 * layers
    row[at] = monitors.drt_bound[0]
    at += 1
    row[at] = lyapunov
    row[at + 1] = world.bounds.joint[0]
    row[at + 2] = world.bounds.paper[0]
    row[at + 3] = world.counts[TOOK_NS] * 1e-3
    row[at + 4] = 1.0 if saturated else 0.0
    row[at + 5] = monitors.clipped[0]
    row[at + 6] = 1.0 if missed else 0.0
    row[at + 7] = world.late_ns[0] * 1e-3
