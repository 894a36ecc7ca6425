"""The rest of a run, and the log of all of it: what was before is copied."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dnnmso_mj.assets import named_files
from dnnmso_mj.errors import LogError
from dnnmso_mj.log.format import MODEL
from dnnmso_mj.log.segments import RESUMED, SEGMENTS, Segment, segments_record
from dnnmso_mj.logged import LoggedRun
from dnnmso_mj.memory_recorder import LARGEST_BLOCK
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.recorded import Recorded
from dnnmso_mj.recorder import Recorder
from dnnmso_mj.recording import McapRecorder
from dnnmso_mj.run import MAX_NUMBERED, open_first_free, run_to_end
from dnnmso_mj.scene import Scene
from dnnmso_mj.simulation import Progress, Simulation
from dnnmso_mj.trace import Event, RunInfo, StepLayout
from dnnmso_mj.world_state import State

Array = np.ndarray


class Model(NamedTuple):
    """A model, and what a log keeps of it: its text, and the files that it names."""

    mjcf: Mjcf
    text: str
    files: Mapping[str, bytes]


@dataclass(frozen=True)
class Continuation:
    """What is left to run, and the log that it goes on from.

    Args:
        source: the log.
        tick: of it, to go on from.
        events: of ticks before that; a torn log may have lost the last ones.
        last: the segment to go on with.
        state: to go on in; None: at the start.
        simulation, model: of that segment.
    """

    source: Recorded
    tick: int
    events: Sequence[Event]
    last: Segment
    state: State | None
    simulation: Simulation
    model: Model

    def record(
        self,
        outs: Iterable[Path],
        where: dict[str, str],
        force: bool,
        progress: Progress | None,
    ) -> LoggedRun:
        """Write the whole run, to the first of `outs` that is free if there are several.

        `where` says what it goes on from.
        """
        scenario, ours, theirs = self.last.scenario, self.simulation.layout, self.source.layout
        layout = ours if ours.n_layers >= theirs.n_layers else theirs
        segments, files = self._history()
        records = {RESUMED: where, **({SEGMENTS: segments_record(segments)} if segments else {})}
        scene = Scene(self.simulation.plant.model)

        def make(out: Path) -> McapRecorder:
            text = self.model.text
            return McapRecorder(
                out, layout, scenario, scene, text, force=force, records=records, files=files
            )

        first, *others = itertools.islice(outs, MAX_NUMBERED)
        recorder = open_first_free((first, *others), make) if others else make(first)
        if recorder is None:
            raise LogError(f"{first}: exists, as do all names like it; name another with --out")
        with recorder:

            def run(progress: Progress) -> RunInfo:
                before = _Widened(recorder, theirs, layout)
                _copy_before(self.source, self.tick, self.events, before)
                return self._go_on(_Widened(recorder, ours, layout), progress)

            return run_to_end(run, recorder, scenario, layout, progress)

    def _go_on(self, recorder: Recorder, progress: Progress) -> RunInfo:
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
                text = self.source.model(part.model)
                own = text == self.model.text
                name = MODEL if own else f"model-{part.first}.xml"
                segments.append(replace(part, model=name))
                if not own:
                    files |= {name: text.encode(), **named_files(text, self.source.files)}
        return [*segments, replace(self.last, model=MODEL)] if segments else [], files


def _copy_before(source: Recorded, tick: int, events: Sequence[Event], recorder: Recorder) -> None:
    """Rows, events and snapshots before a tick, in their order; those of `events` that it lacks."""
    dt, rows = source.trace.scenario.dt, source.layout.rows(source.trace.columns)[:tick]
    marks: list[tuple[int, Callable[[], None]]] = []
    known = {(round(event.t / dt), event.message) for event in source.trace.events}
    lost = [event for event in events if (round(event.t / dt), event.message) not in known]
    for event in [*source.trace.events, *lost]:
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

    @property
    def block(self) -> int:
        """What the recorder takes at once."""
        return self._recorder.block

    def append(self, rows: Array) -> None:
        if self._layout != self._wider:
            rows = self._wider.rows(self._layout.columns(rows))
        self._recorder.append(rows)

    def event(self, event: Event) -> None:
        self._recorder.event(event)

    def snapshot(self, name: str, t: float, arrays: Mapping[str, Array]) -> None:
        self._recorder.snapshot(name, t, arrays)
