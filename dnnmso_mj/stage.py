"""The arm of a scenario and all that acts on it, from tick to tick, whatever drives it.

Reference, sensors, drives, loads, events, and code from outside on them: what a tick leaves to the
interpreter is done here, between two blocks of ticks.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from dnnmso_mj.changes import Changes
from dnnmso_mj.controllers import LEARNING, Command
from dnnmso_mj.divergence import why_it_ended
from dnnmso_mj.errors import EndedEarlyError, NonFiniteError, SafeStopError
from dnnmso_mj.external.imperfection import Hooks
from dnnmso_mj.imperfections.actuators import start_actuators
from dnnmso_mj.imperfections.loads import start_loads
from dnnmso_mj.imperfections.sensors import SensorBank, Sensors, sense
from dnnmso_mj.imperfections.tip import Tip
from dnnmso_mj.memory_recorder import LARGEST_BLOCK
from dnnmso_mj.plant import Mjcf, NominalModel, Plant
from dnnmso_mj.recorder import Recorder
from dnnmso_mj.reference import Reference
from dnnmso_mj.safety import start_safety, what_tripped
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.scenario.controller import lookahead
from dnnmso_mj.theory import start_bounds
from dnnmso_mj.tick import (
    CHUNK_START,
    RECORDED,
    ROWS,
    RUNNING,
    SAFELY_STOPPED,
    STATUS,
    Pace,
    begin_tick,
    end_tick,
)
from dnnmso_mj.timeline import plan, tip_of_interest
from dnnmso_mj.trace import Event, StepLayout
from dnnmso_mj.world import CHUNK, build_world
from dnnmso_mj.world_state import capture, restore

Array = np.ndarray

AS_FAST_AS_CAN_BE = Pace(0, 0, 0.0, np.zeros((0, 2), np.int64))


class Stage:
    """An arm with all that acts on it; call `start` first.

    A tick is `sense`, then `act`; ticks are in blocks, from `open_block` to `close_block`.

    Args:
        scenario: the experiment.
        mjcf: the model that it names.
        plant: made of it.
        layout: of the rows.
        pace: how ticks follow the wall clock; by default they do not.

    Attributes:
        scenario, plant, layout: as given.
        reference: what is to be followed.
        hooks: code from outside on sensors and drives.
        world: all that a tick touches but the controller.
        tick: the next one, between two blocks.

    Raises:
        ScenarioError: the model cannot be used, or does not fit the scenario.
    """

    def __init__(
        self,
        scenario: Scenario,
        mjcf: Mjcf,
        plant: Plant,
        layout: StepLayout,
        pace: Pace = AS_FAST_AS_CAN_BE,
    ) -> None:
        self._mjcf, self.plant, self.layout = mjcf, plant, layout
        sensors = self._perceive(scenario)
        self._nominal = NominalModel(scenario, mjcf)  # the world has it by address alone
        of_interest = tip_of_interest(scenario)
        self._tip = Tip(plant.model, scenario.plant.model) if of_interest else None
        self._lookahead = lookahead(scenario.controller)
        nominal, width = self._nominal.view, layout.width
        self.world = build_world(scenario, plant, self._tip, sensors, nominal, pace, width)
        self._plan = plan(scenario, self.world.loads, self._tip, self.world.inputs.frozen)

    def vary(self, scenario: Scenario) -> None:
        """Take a scenario that differs in seed, initial state and reference alone; then `start`."""
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

    def start(self) -> None:
        """Go to the start of the scenario."""
        scenario, world, n = self.scenario, self.world, self.scenario.n_joints
        x = np.zeros(2 * n)
        x[:n], x[n:] = scenario.initial.q, scenario.initial.qd
        if self._tip is not None:
            self._tip.carry(0.0)
        self.plant.reset(x[:n], x[n:])
        start_actuators(world.actuators)
        start_loads(world.loads)
        start_safety(world.safety)
        self._sensors.start(x)
        q_ref, qd_ref, _ = self.reference.sample(np.zeros(1))
        start_bounds(world.bounds, x - np.concatenate([q_ref[0], qd_ref[0]]))
        world.tau[:] = 0.0
        world.inputs.frozen[0] = LEARNING
        self.tick = self._happened = 0
        world.counts[:] = 0
        self._begin_chunk(0)
        self.hooks.start()
        self._changes = Changes(self.layout, scenario.imperfections.torque_limit)
        self._stop_told = False

    def go_on(self, tick: int, state: Mapping[str, Array]) -> None:
        """From the start to what `state` gave before a tick of this scenario.

        Random numbers until then are passed over.
        """
        self.tick = tick
        for happening in self._plan:
            if happening.tick < tick:
                happening.act()
                self._happened += 1
        for first in range(CHUNK, tick + 1, CHUNK):
            self._begin_chunk(first)
        restore(self.world, self.plant, self.hooks, state)
        # What pushed in the period before is still to be accounted for.
        self.world = self.world._replace(loads=self.world.loads._replace(acting=True))
        self._changes.flags[:] = state["flags"]
        self._stop_told = bool(self.world.safety.ticks[0])

    def state(self) -> dict[str, Array]:
        """What the next tick depends on, copied; see `world_state.capture`."""
        return capture(self.world, self.plant, self.hooks, self._changes.flags)

    def reading(self) -> Array:
        """What the sensors say at the present tick (2n,), and will say again."""
        x = np.concatenate([self.plant.q, self.plant.qd])
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
            for happened in sorted(self._told(rows), key=lambda event: event.t):
                recorder.event(happened)

    @property
    def ended(self) -> bool:
        """Whether a tick of this block ends the run."""
        return bool(self.world.counts[STATUS] != RUNNING)

    def sense(self, k: int) -> bool:
        """Begin tick k: what the controller is told of it; whether it has time to answer.

        A state or a reading that is not finite ends the run here: see `ended`.
        """
        in_time = bool(begin_tick(self.world, k))
        if not self.ended:
            self.hooks.sense(k * self.world.dt, self.world.inputs.x)
        return in_time

    def act(self, k: int, command: Command) -> bool:
        """End tick k with a command, and step the arm; whether the run must end: see `divergence`.

        Raises:
            NonFiniteError: code from outside makes a torque that is not finite, or is given one.
        """
        if not self.hooks or self.ended:
            return bool(end_tick(self.world, command, k))
        if not np.isfinite(command.tau).all():  # it might be made a number of
            raise NonFiniteError("tau_cmd", command.tau.tolist())
        world, row = self.world, self.world.counts[ROWS]
        given = command._replace(tau=self.hooks.actuate(k * world.dt, command.tau))
        ended = bool(end_tick(world, given, k))
        if world.counts[ROWS] > row:  # what was asked for is logged, not what was made of it
            world.rows[row, self.layout.slices["tau_cmd"]] = command.tau
        return ended

    def divergence(self) -> EndedEarlyError:
        """Why the run must end, once the block of that tick is closed."""
        if self.world.counts[STATUS] in RECORDED:
            self.tick -= 1
        if self.world.counts[STATUS] == SAFELY_STOPPED:
            return self._safe_stop()
        return why_it_ended(self.world, self.layout)

    def check_end(self) -> None:
        """Look at what no tick will look at any more, after the scenario's last one.

        Raises:
            NonFiniteError: the last step made a state that is not finite.
            SafeStopError: a safe stop was under way.
        """
        for name, values in (("q", self.plant.q), ("qd", self.plant.qd)):
            if not np.isfinite(values).all():
                raise NonFiniteError(name, values.tolist())
        if self.world.safety.ticks[0] and self.tick == self.scenario.n_ticks:
            raise self._safe_stop()

    def _told(self, rows: Array) -> Iterator[Event]:
        """What a block's rows say has happened, and a safe stop that began in it."""
        yield from self._changes.events(rows)
        if self.world.safety.ticks[0] and not self._stop_told:
            self._stop_told = True
            t = self._stop_tick * self.scenario.dt
            yield Event(t, "warning", f"safe stop: {self._tripped}")

    def _safe_stop(self) -> SafeStopError:
        t = self._stop_tick * self.scenario.dt
        moving = self.world.safety.ticks[1] < self.world.safety.ends[1]
        how = "still moving" if moving else "standing"
        return SafeStopError(f"safe stop: {self._tripped}, at t = {t:.6g} s; {how}")

    @property
    def _stop_tick(self) -> int:
        return int(self.world.safety.ticks[0]) - 1

    @property
    def _tripped(self) -> str:
        return what_tripped(self.scenario.safety, self.world.safety)

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
