"""Go on from any tick of a log: as it was, to the last bit, or with something changed.

The state at a tick is computed again from the snapshot before it, and held against the log on the
way, so that nothing goes on from a state that the log's run was never in.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from dnnmso_mj.branching import branch
from dnnmso_mj.errors import LogError, ScenarioError
from dnnmso_mj.loading.changing import change_scenario
from dnnmso_mj.log.format import MODEL
from dnnmso_mj.log.segments import RESUMED, SEGMENTS, Segment, segments_record
from dnnmso_mj.memory_recorder import LARGEST_BLOCK
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.recomputing import state_at
from dnnmso_mj.recorded import Recorded, read_recorded
from dnnmso_mj.recording import McapRecorder
from dnnmso_mj.run import LoggedRun, run_to_end
from dnnmso_mj.scene import Scene
from dnnmso_mj.simulate import Progress, Recorder, Simulation
from dnnmso_mj.trace import Event, RunInfo, StepLayout
from dnnmso_mj.world_state import State

Array = np.ndarray


@dataclass(frozen=True)
class Resumed:
    """A run that went on from a log.

    Args:
        run: the whole run, from its first tick, and its log.
        tick: where it went on.
        checked: how many ticks before that were computed again and are those of the log.
        branched: what was changed there, and what became of the controller; "" for nothing.
    """

    run: LoggedRun
    tick: int
    checked: int
    branched: str


def resume(
    log: Path,
    at: float,
    sets: Sequence[str] = (),
    out: Path | None = None,
    *,
    force: bool = False,
    progress: Progress | None = None,
) -> Resumed:
    """Run a log's scenario on from a time in it, and leave a log of the whole.

    Args:
        log: complete, interrupted or torn.
        at: when (s), from 0 to where the log ends; at the nearest tick.
        sets: `--set` strings that change the scenario from then on; see `branching`.
        out: the new log; by default LOG-from-AT.mcap beside the log, with a number where that
            exists.
        force: whether an existing `out` is replaced.
        progress: called now and then with the number of ticks done since.

    Raises:
        LogError: the log cannot be read, does not reach to `at`, or is not computed again as it
            was; or `out` exists or cannot be written.
        ScenarioError: the changed scenario cannot be run, or not from there.
        RunInterrupted: Ctrl-C; the new log is whole, with the metrics of what was run.
    """
    source = read_recorded(log)
    tick = _tick(source, at)
    segment = source.segment(tick)
    scenario = change_scenario(segment.scenario, sets, log)
    if scenario.n_ticks < tick:
        raise ScenarioError(
            f"duration = {scenario.duration:g}: ends before --at {at:g}; allowed: {at:g} or more"
        )
    before = _model(source, segment)
    same = scenario.plant.model == segment.scenario.plant.model
    mjcf = before if same else Mjcf.read(find_model(scenario.plant.model))
    state, checked = state_at(source, segment, before, tick)
    simulation = Simulation(scenario, mjcf)
    branched = ""
    if scenario != segment.scenario and state is not None:
        state, told = branch(state, segment.scenario, simulation)
        branched = f"{', '.join(sets)}; {told}"
    layout = _common(source.layout, simulation.layout)
    records, files = _history(source, tick, mjcf, branched)
    records[RESUMED] = {"source": log.name, "at": repr(at), "sets": json.dumps(list(sets))}
    with McapRecorder(
        out or _free_name(log, tick * scenario.dt),
        layout,
        scenario,
        Scene(simulation.plant.model),
        mjcf.text,
        force=force,
        records=records,
        files=files,
    ) as recorder:

        def run() -> RunInfo:
            _copy_before(source, tick, _Widened(recorder, source.layout, layout))
            if state is not None and branched:
                _mark_branch(recorder, simulation, state, log.name, branched)
            return simulation.run(
                _Widened(recorder, simulation.layout, layout), progress, start=state
            )

        done = run_to_end(run, recorder, scenario, layout)
    return Resumed(done, tick, checked, branched)


def _tick(source: Recorded, at: float) -> int:
    """The tick nearest to a time in the log."""
    dt, ticks = source.trace.scenario.dt, len(source.trace)
    if not math.isfinite(at) or not 0 <= round(at / dt) <= ticks:
        raise LogError(f"{source.path}: --at {at:g}: allowed: 0 to {ticks * dt:g} s, its end")
    return round(at / dt)


def _model(source: Recorded, segment: Segment) -> Mjcf:
    """The model of a segment, from the log alone."""
    try:
        return Mjcf(source.files[segment.model].decode())
    except KeyError as error:
        raise LogError(f"{source.path}: has no attachment {segment.model}") from error


def _common(one: StepLayout, other: StepLayout) -> StepLayout:
    """The layout of rows that holds the rows of both."""
    return one if one.n_layers >= other.n_layers else other


def _history(
    source: Recorded, tick: int, mjcf: Mjcf, branched: str
) -> tuple[dict[str, dict[str, str]], dict[str, bytes]]:
    """What a log says of its segments but the last: a record, and models that are not its own."""
    parts = [part for part in source.segments if part.first <= tick]
    first = tick if branched else parts[-1].first
    earlier, files = [], {}
    for part in parts:
        if part.first >= first:
            continue
        text = source.files[part.model]
        name = MODEL if text == mjcf.text.encode() else f"model-{part.first}.xml"
        earlier.append(replace(part, model=name))
        if name != MODEL:
            files[name] = text
    return {SEGMENTS: segments_record(earlier, first)} if earlier else {}, files


def _copy_before(source: Recorded, tick: int, recorder: Recorder) -> None:
    """Rows, events and snapshots before a tick, in their order."""
    dt, rows = source.trace.scenario.dt, source.layout.rows(source.trace.columns)[:tick]
    marks: list[tuple[int, Callable[[], None]]] = []
    for event in source.trace.events:
        marks.append((round(event.t / dt), partial(recorder.event, event)))
    for k, name in source.snapshots:
        arrays = source.arrays(k, name)
        marks.append((k, partial(recorder.snapshot, name, k * dt, arrays)))
    done = 0
    for k, give in sorted(marks, key=lambda mark: mark[0]):
        if k >= tick:
            break
        _append(recorder, rows[done:k])
        done = k
        give()
    _append(recorder, rows[done:])


def _append(recorder: Recorder, rows: Array) -> None:
    for first in range(0, len(rows), LARGEST_BLOCK):
        recorder.append(rows[first : first + LARGEST_BLOCK])


def _mark_branch(
    recorder: Recorder, simulation: Simulation, state: State, name: str, branched: str
) -> None:
    """Say what changed, and keep the state from which a later run can go on."""
    t = state.tick * simulation.scenario.dt
    recorder.event(Event(t, "info", f"resumed from {name} with {branched}"))
    if state.tick % simulation.snapshot_every:  # else the run does
        recorder.snapshot("controller", t, state.controller or {})
        recorder.snapshot("world", t, state.world)


class _Widened:
    """A recorder of rows with as many layers as either controller has.

    Args:
        recorder: takes the wider rows.
        layout: of the rows given.
        wider: of those taken.
    """

    def __init__(self, recorder: McapRecorder, layout: StepLayout, wider: StepLayout) -> None:
        self._recorder, self._layout, self._wider = recorder, layout, wider

    def append(self, rows: Array) -> None:
        if self._layout != self._wider:
            rows = self._wider.rows(self._layout.columns(rows))
        self._recorder.append(rows)

    def event(self, event: Event) -> None:
        self._recorder.event(event)

    def snapshot(self, name: str, t: float, arrays: Mapping[str, Array]) -> None:
        self._recorder.snapshot(name, t, arrays)


def _free_name(log: Path, at: float) -> Path:
    """LOG-from-AT.mcap, or LOG-from-AT-2.mcap …"""
    stem = f"{log.stem}-from-{at:g}"
    names = (f"{stem}{f'-{k}' if k > 1 else ''}.mcap" for k in itertools.count(1))
    return next(path for path in map(log.with_name, names) if not path.exists())
