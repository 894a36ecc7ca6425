"""The one loop: sense, command, learn, record, act, step.

Tick k at t_k = k·dt: read the sensors and the reference, update the controller, record, pass the
command through the actuators, hold the torque for one step. No hidden delay; time is computed,
never accumulated.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Protocol

import numpy as np

from dnnmso_mj.controllers import Command, build_controller
from dnnmso_mj.errors import NonFiniteError
from dnnmso_mj.imperfections import Actuators
from dnnmso_mj.plant import Mjcf, Plant
from dnnmso_mj.reference import Reference
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.theory import TrackingBounds
from dnnmso_mj.trace import Event, RunInfo, StepLayout, Trace

Array = np.ndarray
Progress = Callable[[int], None]

# rad, rad/s: no arm is there and comes back.
DIVERGED_ABOVE = 1e3
MUJOCO_ZEROES_ABOVE = 1e9  # N·m; from 1e10 on MuJoCo drops a torque with a mere warning
BLOCK = 1024  # ticks between two looks at the reference, progress and interrupts
SNAPSHOT_PERIOD = 1.0  # s


class Recorder(Protocol):
    """Where the rows of a run go."""

    def append(self, row: Array) -> None:
        """Take one tick: a row of `StepLayout.width` doubles, copied."""

    def event(self, event: Event) -> None:
        """Take an event."""

    def snapshot(self, name: str, t: float, arrays: dict[str, Array]) -> None:
        """Take the controller's whole state at time t."""


class Row:
    """One tick's numbers in one array, with a named view for each field."""

    def __init__(self, layout: StepLayout) -> None:
        self.data = np.zeros(layout.width)
        self._views = {name: self.data[where] for name, where in layout.slices.items()}

    def __getitem__(self, name: str) -> Array:
        return self._views[name]


class Simulation:
    """A scenario made ready to run: plant, reference, controller and actuators.

    Args:
        scenario: the experiment.
        mjcf: the model that it names.

    Raises:
        ScenarioError: the model cannot be used, or does not fit the scenario.
    """

    def __init__(self, scenario: Scenario, mjcf: Mjcf) -> None:
        n = scenario.n_joints
        self.scenario = scenario
        self.plant = Plant(scenario, mjcf)
        self.reference = Reference(scenario.reference, n)
        self.controller = build_controller(scenario, mjcf)
        self.actuators = Actuators(scenario.imperfections, n)
        self.layout = StepLayout(n, self.controller.n_layers)
        self._row = Row(self.layout)
        self._tau = np.zeros(n)
        self._e_track = np.zeros(2 * n)
        self._x, self._x_ref, self._xd_ref = np.zeros(2 * n), np.zeros(2 * n), np.zeros(2 * n)
        self._f_true = self._row["f_true"]
        self._f_err = np.zeros(2 * n)
        self._was_saturated = False

    def run(self, recorder: Recorder, progress: Progress | None = None) -> RunInfo:
        """Run the scenario from its start to its end, or to its divergence.

        Args:
            recorder: takes rows, events and snapshots.
            progress: called now and then with the number of ticks done.

        Returns:
            Status "ok" or "diverged" (with the reason), the seed and the wall time of the loop.
        """
        started = time.perf_counter()
        status, reason = "ok", ""
        try:
            self._loop(recorder, progress)
        except NonFiniteError as error:
            t = float(self._row["t"][0])
            status, reason = "diverged", f"{error} at t = {t:.6g} s"
            recorder.event(Event(t, "error", f"diverged: {reason}"))
        wall = time.perf_counter() - started
        return RunInfo(status=status, seed=self.scenario.seed, wall_s=wall, reason=reason)

    def _loop(self, recorder: Recorder, progress: Progress | None) -> None:
        scenario, n = self.scenario, self.scenario.n_joints
        self._start()
        n_ticks, dt = scenario.n_ticks, scenario.dt
        snapshot_every = max(1, round(SNAPSHOT_PERIOD / dt))
        for first in range(0, n_ticks, BLOCK):
            ticks = np.arange(first, min(first + BLOCK, n_ticks))
            q_ref, qd_ref, qdd_ref = self.reference.sample(ticks * dt)
            for i, k in enumerate(ticks.tolist()):
                if k % snapshot_every == 0:
                    recorder.snapshot("controller", k * dt, self.controller.state())
                self._x_ref[:n], self._x_ref[n:] = q_ref[i], qd_ref[i]
                self._xd_ref[:n], self._xd_ref[n:] = qd_ref[i], qdd_ref[i]
                self._tick(k, recorder)
            if progress is not None:
                progress(len(ticks))
        recorder.snapshot("controller", n_ticks * dt, self.controller.state())

    def _start(self) -> None:
        scenario, n = self.scenario, self.scenario.n_joints
        x = self._x
        x[:n] = scenario.initial.q
        x[n:] = scenario.initial.qd
        self.plant.reset(x[:n], x[n:])
        self.controller.reset(x)
        q_ref, qd_ref, _ = self.reference.sample(np.zeros(1))
        e_track = x - np.concatenate([q_ref[0], qd_ref[0]])
        inversion = scenario.controller.inversion
        self._bounds = TrackingBounds(inversion, n, scenario.dt, e_track)

    def _tick(self, k: int, recorder: Recorder) -> None:
        n, row = self.scenario.n_joints, self._row
        t = k * self.scenario.dt
        self._x[:n], self._x[n:] = self.plant.q, self.plant.qd
        np.subtract(self._x, self._x_ref, out=self._e_track)
        if k > 0:
            qdd = self.plant.acceleration(self._tau)
            self._bounds.end(self._e_track, qdd - self._xd_ref[n:])
        row["t"][0] = t
        began = time.perf_counter_ns()
        command = self.controller.update(self._x, self._x_ref, self._xd_ref)
        row["compute_us"][0] = (time.perf_counter_ns() - began) * 1e-3
        tau = self.actuators.apply(command.tau)
        if not math.isfinite(tau.sum()):
            raise NonFiniteError("tau", command.tau.tolist())
        if np.abs(tau).max() > MUJOCO_ZEROES_ABOVE:
            raise NonFiniteError("tau", f"{tau.tolist()}, above {MUJOCO_ZEROES_ABOVE:g}")
        self._true_dynamics(command, tau)
        self._fill(command, tau)
        self._check_finite(row)
        recorder.append(row.data)
        self._check_range(row)
        self._watch_saturation(t, recorder)
        self._bounds.begin(self._f_err)
        self._tau[:] = tau
        self.plant.step(tau)

    def _true_dynamics(self, command: Command, tau: Array) -> None:
        """f_true = Ẋ − B τ, and what the closed loop feels of it, Ẋ − B τ_cmd − f̂."""
        n, f_true = self.scenario.n_joints, self._f_true
        f_true[:n] = self._x[n:]
        f_true[n:] = self.plant.acceleration(tau)
        np.subtract(f_true, command.Bu, out=self._f_err)
        self._f_err -= command.f_hat
        f_true -= self.controller.effect(tau) if self.actuators.saturated else command.Bu

    def _fill(self, command: Command, tau: Array) -> None:
        n, row, monitors = self.scenario.n_joints, self._row, command.monitors
        row["q"][:], row["qd"][:] = self._x[:n], self._x[n:]
        row["q_meas"][:], row["qd_meas"][:] = self._x[:n], self._x[n:]
        row["q_ref"][:], row["qd_ref"][:] = self._x_ref[:n], self._x_ref[n:]
        row["tau_cmd"][:], row["tau"][:] = command.tau, tau
        row["x_hat"][:], row["f_hat"][:] = command.x_hat, command.f_hat
        row["e_obs"][:] = command.e_obs
        row["weight_norm"][:] = monitors.weight_norm
        row["update_ratio"][:] = monitors.update_ratio
        row["eta_bound"][:] = monitors.eta_bound
        row["gradient_change"][:] = monitors.gradient_change
        row["drt_bound"][0] = monitors.drt_bound
        e_track = self._e_track
        row["lyapunov"][0] = e_track.dot(e_track)
        row["ultimate_bound"][0] = self._bounds.joint
        row["ultimate_bound_paper"][0] = self._bounds.paper
        row["saturated"][0] = self.actuators.saturated
        row["clipped"][0] = monitors.clipped

    def _check_finite(self, row: Row) -> None:
        if not np.isfinite(row.data).all():
            name = next(f for f in self.layout.widths if not np.isfinite(row[f]).all())
            raise NonFiniteError(name, row[name].tolist())

    def _check_range(self, row: Row) -> None:
        """Stop where the state has left this world, long before numbers overflow."""
        for name in ("q", "qd", "x_hat"):
            largest = float(np.abs(row[name]).max())
            if largest > DIVERGED_ABOVE:
                raise NonFiniteError(f"|{name}|", f"{largest:.4g}, above {DIVERGED_ABOVE:g}")

    def _watch_saturation(self, t: float, recorder: Recorder) -> None:
        if self.actuators.saturated != self._was_saturated:
            self._was_saturated = self.actuators.saturated
            what = "torque limit reached" if self._was_saturated else "torque limit left"
            recorder.event(Event(t, "warning" if self._was_saturated else "info", what))


class MemoryRecorder:
    """Keeps a run in memory and makes a `Trace` of it.

    Args:
        layout: of the rows.
        n_ticks: how many rows there can be.
    """

    def __init__(self, layout: StepLayout, n_ticks: int) -> None:
        self._layout = layout
        self._rows = np.empty((n_ticks, layout.width))
        self._count = 0
        self._events: list[Event] = []

    def append(self, row: Array) -> None:
        self._rows[self._count] = row
        self._count += 1

    def event(self, event: Event) -> None:
        self._events.append(event)

    def snapshot(self, name: str, t: float, arrays: dict[str, Array]) -> None:
        """Snapshots are for logs; memory keeps none."""

    def trace(self, scenario: Scenario, info: RunInfo) -> Trace:
        """The columns recorded so far."""
        columns = self._layout.columns(self._rows[: self._count])
        return Trace(columns, scenario, info, tuple(self._events))


def simulate(scenario: Scenario, mjcf: Mjcf | None = None) -> Trace:
    """Run a scenario in memory.

    Args:
        scenario: the experiment.
        mjcf: its model; by default the one that `scenario.plant.model` names.
    """
    if mjcf is None:
        from dnnmso_mj.paths import find_model

        mjcf = Mjcf.read(find_model(scenario.plant.model))
    simulation = Simulation(scenario, mjcf)
    recorder = MemoryRecorder(simulation.layout, scenario.n_ticks)
    info = simulation.run(recorder)
    return recorder.trace(scenario, info)
