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
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from dnnmso_mj.assets import put_back, read_assets
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
from dnnmso_mj.simulation import Progress, Recorder, Simulation
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
        told: the event that says what was changed there; "" for nothing.
    """

    run: LoggedRun
    tick: int
    checked: int
    told: str


def resume(
    log: Path,
    at: float,
    sets: Sequence[str] = (),
    out: Path | None = None,
    *,
    force: bool = False,
    trust: bool = False,
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
        trust: whether the log's scenario and `sets` may name code by import path.
        progress: called now and then with the number of ticks done since.

    Raises:
        LogError: the log cannot be read, does not reach to `at`, or is not computed again as it
            was; or `out` exists or cannot be written.
        ScenarioError: the changed scenario cannot be run, or not from there.
        RunInterrupted: Ctrl-C; the new log is whole, with the metrics of what was run.
    """
    source = read_recorded(log)
    if out is not None and out.resolve() == log.resolve():
        raise LogError(f"--out {out}: is the log itself; allowed: another name")
    tick = _tick(source, at)
    segment = source.segment(tick)
    scenario = change_scenario(segment.scenario, sets, log, trust=trust)
    if scenario.n_ticks < tick:
        raise ScenarioError(
            f"duration = {scenario.duration:g}: ends before --at {at:g}; allowed: {at:g} or more"
        )
    with TemporaryDirectory(prefix="dnnmso-") as folder:
        own = _model(source, segment, Path(folder))
        same = scenario.plant.model == segment.scenario.plant.model
        model = own if same else _model_file(scenario.plant.model)
        simulation = Simulation(scenario, model.mjcf)
        state, checked = state_at(source, segment, own.mjcf, tick)
        last = segment
        if scenario != segment.scenario:
            told = ""
            if state is not None:
                state, became = branch(state, segment.scenario, simulation)
                told = f"resumed from {log.name} with {', '.join(sets)}; {became}"
            last = Segment(tick, scenario, told=told)
        where = {"source": log.name, "at": repr(at), "sets": json.dumps(list(sets))}
        target = out or _free_name(log, tick * scenario.dt)
        follow = _Continuation(source, tick, last, state, simulation, model)
        done = follow.record(target, where, force, progress)
    return Resumed(done, tick, checked, last.told if last.first == tick else "")


@dataclass(frozen=True)
class _Continuation:
    """What is left to run, and the log that it goes on from.

    Args:
        source: the log.
        tick: of it, to go on from.
        last: the segment to go on with.
        state: to go on in; None: at the start.
        simulation, model: of that segment.
    """

    source: Recorded
    tick: int
    last: Segment
    state: State | None
    simulation: Simulation
    model: _Model

    def record(
        self, out: Path, where: dict[str, str], force: bool, progress: Progress | None
    ) -> LoggedRun:
        """Write the whole run; `where` says what it goes on from."""
        scenario, ours, theirs = self.last.scenario, self.simulation.layout, self.source.layout
        layout = ours if ours.n_layers >= theirs.n_layers else theirs
        segments, files = self._history()
        records = {RESUMED: where, **({SEGMENTS: segments_record(segments)} if segments else {})}
        scene = Scene(self.simulation.plant.model)
        with McapRecorder(
            out, layout, scenario, scene, self.model.text, force=force, records=records, files=files
        ) as recorder:

            def run() -> RunInfo:
                _copy_before(self.source, self.tick, _Widened(recorder, theirs, layout))
                return self._go_on(_Widened(recorder, ours, layout), progress)

            return run_to_end(run, recorder, scenario, layout)

    def _go_on(self, recorder: Recorder, progress: Progress | None) -> RunInfo:
        state, simulation = self.state, self.simulation
        if state is not None and self.last.first == self.tick:
            t = self.tick * self.last.scenario.dt
            recorder.event(Event(t, "info", self.last.told))
            if self.tick % simulation.snapshot_every:  # else the run keeps one
                recorder.snapshot("controller", t, state.controller or {})
                recorder.snapshot("world", t, state.world)
        return simulation.run(recorder, progress, start=state)

    def _history(self) -> tuple[list[Segment], dict[str, bytes]]:
        """The segments, if there are several, and the models that are not the log's own."""
        segments, files = [], dict(self.model.files)
        for part in self.source.segments:
            if part.first < self.last.first:
                text = self.source.files[part.model]
                own = text == self.model.text.encode()
                name = MODEL if own else f"model-{part.first}.xml"
                segments.append(replace(part, model=name))
                if not own:
                    files |= {name: text, **self.source.assets}
        return [*segments, replace(self.last, model=MODEL)] if segments else [], files


def _tick(source: Recorded, at: float) -> int:
    """The tick nearest to a time in the log."""
    dt, ticks = source.trace.scenario.dt, len(source.trace)
    if not math.isfinite(at) or not 0 <= round(at / dt) <= ticks:
        raise LogError(f"{source.path}: --at {at:g}: allowed: 0 to {ticks * dt:g} s, its end")
    return round(at / dt)


class _Model(NamedTuple):
    """A model and all that a log keeps of it."""

    mjcf: Mjcf
    text: str
    files: Mapping[str, bytes]


def _model(source: Recorded, segment: Segment, folder: Path) -> _Model:
    """The model of a segment, from the log alone; its meshes go to a folder."""
    data = source.files.get(segment.model)
    if data is None:
        raise LogError(f"{source.path}: has no attachment {segment.model}; it cannot be resumed")
    text = data.decode()
    return _Model(put_back(text, source.assets, folder), text, source.assets)


def _model_file(name: str) -> _Model:
    mjcf = Mjcf.read(find_model(name))
    return _Model(mjcf, mjcf.text, read_assets(mjcf))


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
