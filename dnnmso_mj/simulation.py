"""The one loop: sense, command, learn, record, act, step; see `tick` for what one tick is.

Ticks run in blocks. A controller with compiled ticks runs a block without the interpreter; any
other has its `update` called tick by tick between the same two compiled halves.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np
from numba.core import event

from dnnmso_mj.changes import Changes
from dnnmso_mj.compile_loop import compile_elsewhere, compile_halves_elsewhere
from dnnmso_mj.compiling import CompileNotice
from dnnmso_mj.controllers import (
    LEARNING,
    Command,
    Controller,
    build_controller,
    compiled_ticks,
)
from dnnmso_mj.divergence import not_finite, why_it_ended
from dnnmso_mj.errors import NonFiniteError
from dnnmso_mj.external.imperfection import Hooks
from dnnmso_mj.imperfections.actuators import start_actuators
from dnnmso_mj.imperfections.loads import start_loads
from dnnmso_mj.imperfections.sensors import SensorBank, Sensors, sense
from dnnmso_mj.imperfections.tip import Tip
from dnnmso_mj.memory_recorder import LARGEST_BLOCK, MemoryRecorder
from dnnmso_mj.plant import Mjcf, NominalModel, Plant
from dnnmso_mj.reference import Reference
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.scenario.controller import lookahead
from dnnmso_mj.theory import start_bounds
from dnnmso_mj.tick import (
    CHUNK_START,
    OUT_OF_RANGE,
    ROWS,
    RUNNING,
    START_NS,
    STATUS,
    TOOK_NS,
    Pace,
    begin_tick,
    end_tick,
)
from dnnmso_mj.timeline import plan, tip_of_interest
from dnnmso_mj.trace import Event, RunInfo, StepLayout, Trace
from dnnmso_mj.world import CHUNK, build_world
from dnnmso_mj.world_state import State, capture, restore

Array = np.ndarray
Progress = Callable[[int], None]

HEAD_START_NS = 20_000_000  # from a paced run's beginning to its first tick
BLOCK = 50  # ticks between two looks at the recorder, progress and interrupts
SNAPSHOT_PERIOD = 1.0  # s
AS_FAST_AS_CAN_BE = Pace(0, 0, 0.0, np.zeros((0, 2), np.int64))


class Recorder(Protocol):
    """Where the rows of a run go.

    One with an attribute `block` takes that many at once; one whose `keeps_snapshots` is False is
    given none.
    """

    def append(self, rows: Array) -> None:
        """Take some ticks: rows (m, `StepLayout.width`), which are overwritten afterwards."""

    def event(self, event: Event) -> None:
        """Take an event."""

    def snapshot(self, name: str, t: float, arrays: Mapping[str, Array]) -> None:
        """Take the whole state of the controller, or of the world, at time t (s)."""


class Simulation:
    """A scenario made ready to run: plant, reference, controller and actuators.

    Args:
        scenario: the experiment.
        mjcf: the model that it names.
        watch: whether the network's monitors are kept; without them all other columns are the same.
        pace: how ticks follow the wall clock; by default they do not.
        controller: by default the one that the scenario names.

    Raises:
        ScenarioError: the model cannot be used, or does not fit the scenario.
    """

    def __init__(
        self,
        scenario: Scenario,
        mjcf: Mjcf,
        *,
        watch: bool = True,
        pace: Pace = AS_FAST_AS_CAN_BE,
        controller: Controller | None = None,
    ) -> None:
        self._mjcf = mjcf
        self.plant = Plant(scenario, mjcf)
        sensors = self._perceive(scenario)
        self._given = controller is not None  # and no other process can make it again
        self.controller = controller or build_controller(scenario, mjcf, watch=watch)
        self.layout = StepLayout(scenario.n_joints, self.controller.n_layers)
        self._nominal = NominalModel(scenario, mjcf)
        of_interest = tip_of_interest(scenario)
        self._tip = Tip(self.plant.model, scenario.plant.model) if of_interest else None
        self._lookahead = lookahead(scenario.controller)
        nominal, width = self._nominal.view, self.layout.width
        self.world = build_world(scenario, self.plant, self._tip, sensors, nominal, pace, width)
        self._plan = plan(scenario, self.world.loads, self._tip, self.world.inputs.frozen)
        self._first_state: dict[str, Array] | None = None

    def run(
        self,
        recorder: Recorder,
        progress: Progress | None = None,
        *,
        start: State | None = None,
        until: int | None = None,
    ) -> RunInfo:
        """Run the scenario from its start to its end, or to its divergence.

        Args:
            recorder: takes rows, events and snapshots.
            progress: called now and then with the number of ticks done since.
            start: where to go on instead, of a run of this scenario; see `state`.
            until: the tick to stop before, instead of at the scenario's end.

        Returns:
            Status "ok" or "diverged" (with the reason), the seed and the wall time of the loop.
        """
        status, reason = "ok", ""
        self.begin(start)
        started = time.perf_counter()
        try:
            self._loop(recorder, progress, self.scenario.n_ticks if until is None else until)
        except NonFiniteError as error:
            t = self.tick * self.scenario.dt
            state = self.controller.state()
            causes = not_finite(state)
            cause = f" with {', '.join(causes)} not finite" if causes else ""
            status, reason = "diverged", f"{error}{cause} at t = {t:.6g} s"
            recorder.event(Event(t, "error", f"diverged: {reason}"))
            recorder.snapshot("controller", t, state)
        wall = time.perf_counter() - started
        return RunInfo(status=status, seed=self.scenario.seed, wall_s=wall, reason=reason)

    @property
    def snapshot_every(self) -> int:
        """Ticks between two snapshots."""
        return max(1, round(SNAPSHOT_PERIOD / self.scenario.dt))

    def begin(self, start: State | None = None) -> None:
        """Go to the start of the scenario, or to a state that a run of it was in."""
        self._ticks = None if self.hooks else compiled_ticks(self.controller)
        self._prepare()
        if self._first_state is None:
            self._first_state = self.controller.state()
        else:
            self.controller.restore(self._first_state)
        self._start()
        if start is not None:
            self._go_on(start)

    def vary(self, scenario: Scenario) -> None:
        """Take a scenario that differs in seed, initial state and reference alone; then `begin`."""
        self.world = self.world._replace(sensors=self._perceive(scenario))

    def _perceive(self, scenario: Scenario) -> Sensors:
        """What the controller will be told: reference, sensors, and code from outside on them."""
        n, seed = scenario.n_joints, scenario.seed
        self.scenario = scenario
        self.reference = Reference(scenario.reference, n, scenario.duration)
        self.hooks = Hooks(scenario, self._mjcf)
        self._sensors = SensorBank(scenario.imperfections, n, scenario.dt, seed, CHUNK)
        view = self._sensors.view
        return view._replace(perfect=view.perfect and not self.hooks)

    def state(self) -> State:
        """The state after `begin` or a run that has not diverged, copied."""
        world = capture(self.world, self.plant, self.hooks, self._changes.flags)
        return State(self.tick, self.controller.state(), world)

    def _prepare(self) -> None:
        """Load or compile what ticks need, so that none of them pays for it."""
        if self._ticks is None and not self._given:
            compile_halves_elsewhere(self.world, self.scenario, self._mjcf)
        with event.install_listener("numba:compile", CompileNotice()):
            if self._ticks is not None:
                arguments = (self.world, self._ticks.parts, 0, 0)
                if not self._given:
                    compile_elsewhere(self._ticks.run, arguments, self.scenario, self._mjcf)
                self._ticks.run(*arguments)
            elif self.world.pace.period_ns:
                state, world = self.controller.state(), self.world
                self._start()
                begin_tick(world, 0)
                self._command = self.controller.update(world.inputs)
                end_tick(world, self._command, 0)
                self.controller.restore(state)

    def _start(self) -> None:
        scenario, world, n = self.scenario, self.world, self.scenario.n_joints
        x = np.zeros(2 * n)
        x[:n], x[n:] = scenario.initial.q, scenario.initial.qd
        if self._tip is not None:
            self._tip.carry(0.0)
        self.plant.reset(x[:n], x[n:])
        start_actuators(world.actuators)
        start_loads(world.loads)
        self._sensors.start(x)
        q_ref, qd_ref, _ = self.reference.sample(np.zeros(1))
        start_bounds(world.bounds, x - np.concatenate([q_ref[0], qd_ref[0]]))
        world.tau[:] = 0.0
        world.inputs.frozen[0] = LEARNING
        self.tick = self._happened = 0
        world.counts[:] = 0
        self._begin_chunk(0)
        self.hooks.start()
        self.controller.reset(self._reading(x))
        self._changes = Changes(self.layout)

    def _go_on(self, start: State) -> None:
        """From the scenario's start to a later state; random numbers until then are passed over."""
        self.tick = start.tick
        for happening in self._plan:
            if happening.tick < start.tick:
                happening.act()
                self._happened += 1
        for first in range(CHUNK, start.tick + 1, CHUNK):
            self._begin_chunk(first)
        restore(self.world, self.plant, self.hooks, start.world)
        # What pushed in the period before is still to be accounted for.
        self.world = self.world._replace(loads=self.world.loads._replace(acting=True))
        self._changes.flags[:] = start.world["flags"]
        if start.controller is None:
            self.controller.reset(self._reading(np.concatenate([self.plant.q, self.plant.qd])))
        else:
            self.controller.restore(start.controller)

    def _reading(self, x: Array) -> Array:
        """What the sensors say of the state x (2n,) at the present tick, and will say again."""
        reading, sensors, k = x.copy(), self._sensors.view, self.tick
        if not sensors.perfect:
            last = sensors.last.copy()
            sense(sensors, x, k, k % CHUNK, reading)
            sensors.last[:] = last
        if self.hooks:
            before = self.hooks.state()
            self.hooks.sense(k * self.scenario.dt, reading)
            self.hooks.restore(before)
        return reading

    def _loop(self, recorder: Recorder, progress: Progress | None, n_ticks: int) -> None:
        snapshot_every = self.snapshot_every
        most = min(getattr(recorder, "block", BLOCK), LARGEST_BLOCK)
        self.world.counts[START_NS] = time.monotonic_ns() + HEAD_START_NS
        while self.tick < n_ticks:
            first = self.tick
            if first % snapshot_every == 0:
                self._give_state(recorder)
            end = min(self.open_block(recorder, most), n_ticks)
            count = min(end, (first // snapshot_every + 1) * snapshot_every) - first
            self._run_block(first, count, recorder)
            if progress is not None:
                progress(count)
        self._give_state(recorder)

    def _give_state(self, recorder: Recorder) -> None:
        """A snapshot of the present state, for a recorder that keeps it."""
        if getattr(recorder, "keeps_snapshots", True):
            t, state = self.tick * self.scenario.dt, self.state()
            recorder.snapshot("controller", t, state.controller or {})
            recorder.snapshot("world", t, state.world)

    def open_block(self, recorder: Recorder, most: int = LARGEST_BLOCK) -> int:
        """Begin a block of ticks, with what happens before its first one.

        Args:
            recorder: is told what happens.
            most: ticks in it, at most `LARGEST_BLOCK`.

        Returns:
            The tick that it must be closed before.
        """
        first, counts = self.tick, self.world.counts
        if first == counts[CHUNK_START] + CHUNK:
            self._begin_chunk(first)
        counts[ROWS], counts[STATUS] = 0, RUNNING
        return min(first + most, int(counts[CHUNK_START]) + CHUNK, self._happen(recorder))

    def close_block(self, recorder: Recorder) -> None:
        """Give the rows of a block's ticks, and what changed in them, to the recorder."""
        rows = self.world.rows[: self.world.counts[ROWS]]
        self.tick += len(rows)
        if len(rows):
            recorder.append(rows)
            for change in self._changes.events(rows):
                recorder.event(change)

    def sense(self, k: int) -> bool:
        """Begin tick k: what the controller is told of it; whether it has time to answer."""
        in_time = bool(begin_tick(self.world, k))
        self.hooks.sense(k * self.world.dt, self.world.inputs.x)
        return in_time

    def act(self, k: int, command: Command) -> bool:
        """End tick k with a command, and step the arm; whether the run must end: see `divergence`.

        Raises:
            NonFiniteError: code from outside makes a torque that is not finite.
        """
        if not self.hooks:
            return bool(end_tick(self.world, command, k))
        world, row = self.world, self.world.counts[ROWS]
        given = command._replace(tau=self.hooks.actuate(k * world.dt, command.tau))
        ended = bool(end_tick(world, given, k))
        if world.counts[ROWS] > row:  # what was asked for is logged, not what was made of it
            world.rows[row, self.layout.slices["tau_cmd"]] = command.tau
        return ended

    def divergence(self) -> NonFiniteError:
        """Why the run must end, once the block of that tick is closed."""
        if self.world.counts[STATUS] == OUT_OF_RANGE:
            self.tick -= 1  # such a row is recorded
        return why_it_ended(self.world, self.layout)

    def _happen(self, recorder: Recorder) -> int:
        """Let every event up to this tick happen; the tick of the next one, or the last."""
        tick, last = self.tick, self.scenario.n_ticks
        for happening in self._plan[self._happened :]:
            if happening.tick > tick or tick == last:
                return happening.tick
            self._happened += 1
            happening.act()
            recorder.event(Event(tick * self.scenario.dt, "info", happening.message))
        return last

    def _begin_chunk(self, first: int) -> None:
        """Reference and random numbers of the ticks from `first` on."""
        world = self.world
        world.counts[CHUNK_START] = first
        self._sensors.draw()
        t = np.arange(first, first + CHUNK) * self.scenario.dt
        world.reference[:] = np.hstack(self.reference.sample(t))
        if self._lookahead:
            world.ahead[:] = np.hstack(self.reference.sample(t + self._lookahead))

    def _run_block(self, first: int, count: int, recorder: Recorder) -> None:
        """Ticks first to first + count, and their rows to the recorder.

        Raises:
            NonFiniteError: the run must end; rows before it are recorded.
        """
        try:
            if self._ticks is not None:
                self._ticks.run(self.world, self._ticks.parts, first, count)
            else:
                self._run_interpreted(first, count)
        finally:
            self.close_block(recorder)
        if self.world.counts[STATUS] != RUNNING:
            raise self.divergence()

    def _run_interpreted(self, first: int, count: int) -> None:
        world = self.world
        for k in range(first, first + count):
            if self.sense(k):
                began = time.perf_counter_ns()
                self._command = self.controller.update(world.inputs)
                world.counts[TOOK_NS] = time.perf_counter_ns() - began
            if self.act(k, self._command):
                return


def simulate(scenario: Scenario, mjcf: Mjcf | None = None, *, watch: bool = True) -> Trace:
    """Run a scenario in memory.

    Args:
        scenario: the experiment.
        mjcf: its model; by default the one that `scenario.plant.model` names.
        watch: whether the network's monitors are kept; without them a tick takes less time.
    """
    if mjcf is None:
        from dnnmso_mj.paths import find_model

        mjcf = Mjcf.read(find_model(scenario.plant.model))
    simulation = Simulation(scenario, mjcf, watch=watch)
    recorder = MemoryRecorder(simulation.layout, scenario.n_ticks)
    info = simulation.run(recorder)
    return recorder.trace(scenario, info)
