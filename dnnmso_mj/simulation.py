"""The one loop: sense, command, learn, record, act, step; see `tick` for what one tick is.

Ticks run in blocks. A controller with compiled ticks runs a block without the interpreter; any
other has its `update` called tick by tick between the same two compiled halves.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

import numpy as np
from numba.core import event

from dnnmso_mj.compile_loop import compile_elsewhere, compile_halves_elsewhere
from dnnmso_mj.compiling import CompileNotice
from dnnmso_mj.controllers import Controller, build_controller, compiled_ticks, no_command
from dnnmso_mj.divergence import far_state, not_finite
from dnnmso_mj.errors import EndedEarlyError, NonFiniteError
from dnnmso_mj.memory_recorder import LARGEST_BLOCK, MemoryRecorder
from dnnmso_mj.plant import Mjcf, Plant
from dnnmso_mj.recorder import Recorder
from dnnmso_mj.scenario import External, Policy, Scenario
from dnnmso_mj.stage import AS_FAST_AS_CAN_BE, Stage
from dnnmso_mj.tick import RUNNING, START_NS, STATUS, TOOK_NS, Pace, begin_tick, end_tick
from dnnmso_mj.trace import Event, RunInfo, StepLayout, Trace
from dnnmso_mj.world_state import State

Array = np.ndarray
Progress = Callable[[int], None]

HEAD_START_NS = 20_000_000  # from a paced run's beginning to its first tick
BLOCK = 50  # ticks between two looks at the recorder, progress and interrupts
SNAPSHOT_PERIOD = 1.0  # s


class Simulation:
    """A scenario made ready to run: its stage, and its controller.

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
        self.scenario, self._mjcf = scenario, mjcf
        self.plant = Plant(scenario, mjcf)
        self._given = controller is not None  # and no other process can make it again
        self.controller = controller or build_controller(scenario, mjcf, watch=watch)
        self.layout = StepLayout(scenario.n_joints, self.controller.n_layers)
        self.stage = Stage(scenario, mjcf, self.plant, self.layout, pace)
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
            Status "ok" or "diverged" (with the reason; a safe stop's begins with "safe stop"), the
            seed and the wall time of the loop.
        """
        status, reason = "ok", ""
        self.begin(start)
        started = time.perf_counter()
        try:
            self._loop(recorder, progress, self.scenario.n_ticks if until is None else until)
        except EndedEarlyError as error:
            t = self.stage.tick * self.scenario.dt
            state = self.controller.state()
            status, reason = "diverged", f"{error}{_causes(error, state)} at t = {t:.6g} s"
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
        self._ticks = None if self.stage.hooks else compiled_ticks(self.controller)
        self._prepare()
        if self._first_state is None:
            self._first_state = self.controller.state()
        else:
            self.controller.restore(self._first_state)
        self._start()
        if start is None:
            return
        self.stage.go_on(start.tick, start.world)
        if start.controller is None:
            self.controller.reset(self.stage.reading())
        else:
            self.controller.restore(start.controller)

    def state(self) -> State:
        """The state after `begin` or a run that has not diverged, copied."""
        return State(self.stage.tick, self.controller.state(), self.stage.state())

    def _prepare(self) -> None:
        """Load or compile what ticks need, so that none of them pays for it."""
        world = self.stage.world
        if self._ticks is None and not self._given:
            compile_halves_elsewhere(world, self.scenario, self._mjcf)
        with event.install_listener("numba:compile", CompileNotice()):
            if self._ticks is not None:
                arguments = (world, self._ticks.parts, 0, 0)
                if not self._given:
                    compile_elsewhere(self._ticks.run, arguments, self.scenario, self._mjcf)
                self._ticks.run(*arguments)
            elif world.pace.period_ns:
                state = self.controller.state()
                self._start()
                begin_tick(world, 0)
                command = self.controller.update(world.inputs)
                end_tick(world, command, 0)
                self._command = no_command(command)  # of a first tick that is begun too late
                self.controller.restore(state)

    def _start(self) -> None:
        self.stage.start()
        self.controller.reset(self.stage.reading())

    def _loop(self, recorder: Recorder, progress: Progress | None, n_ticks: int) -> None:
        """Ticks up to `n_ticks`.

        Raises:
            EndedEarlyError: the run ends before them; rows of before are recorded.
        """
        stage, snapshot_every = self.stage, self.snapshot_every
        stage.world.counts[START_NS] = time.monotonic_ns() + HEAD_START_NS
        while stage.tick < n_ticks:
            first = stage.tick
            if first % snapshot_every == 0:
                self._check_controller()
                self._give_state(recorder)
            most = min(getattr(recorder, "block", BLOCK), LARGEST_BLOCK)
            end = min(stage.open_block(recorder, most), n_ticks)
            count = min(end, (first // snapshot_every + 1) * snapshot_every) - first
            self._run_block(first, count, recorder)
            if progress is not None:
                progress(count)
        stage.check_end()
        self._check_controller()
        self._give_state(recorder)

    def _check_controller(self) -> None:
        """Look at all that the controller keeps, which may not show in its torque.

        Raises:
            NonFiniteError: something is not finite; what code from outside keeps is its own affair.
        """
        if self._given or isinstance(self.scenario.controller, External | Policy):
            return
        for name in not_finite(state := self.controller.state()):
            values = state[name].ravel()
            at = int(np.flatnonzero(~np.isfinite(values))[0])
            raise NonFiniteError(name, f"{values[at]} at entry {at}")

    def _give_state(self, recorder: Recorder) -> None:
        """A snapshot of the present state, for a recorder that keeps it."""
        if getattr(recorder, "keeps_snapshots", True):
            state = self.state()
            t = state.tick * self.scenario.dt
            recorder.snapshot("controller", t, state.controller or {})
            recorder.snapshot("world", t, state.world)

    def _run_block(self, first: int, count: int, recorder: Recorder) -> None:
        """Ticks first to first + count, and their rows to the recorder.

        Raises:
            EndedEarlyError: the run must end; rows before it are recorded.
        """
        stage = self.stage
        try:
            if self._ticks is not None:
                self._ticks.run(stage.world, self._ticks.parts, first, count)
            else:
                self._run_interpreted(first, count)
        except NonFiniteError as error:  # what a controller noticed may come of where the arm is
            raise (far_state(stage.world) or error) from error
        finally:
            stage.close_block(recorder)
        if stage.world.counts[STATUS] != RUNNING:
            raise stage.divergence()

    def _run_interpreted(self, first: int, count: int) -> None:
        stage, world = self.stage, self.stage.world
        for k in range(first, first + count):
            if stage.sense(k):
                began = time.perf_counter_ns()
                self._command = self.controller.update(world.inputs)
                world.counts[TOOK_NS] = time.perf_counter_ns() - began
            if stage.ended or stage.act(k, self._command):
                return


def _causes(error: EndedEarlyError, state: Mapping[str, Array]) -> str:
    """What else is not finite, in words."""
    if not isinstance(error, NonFiniteError):
        return ""
    names = [name for name in not_finite(state) if name != error.quantity]
    return f" with {', '.join(names)} not finite" if names else ""


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
