"""Runs as the content of a Rerun file, with the layout to see them in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import rerun as rr

from dnnmso_mj.errors import LogError
from dnnmso_mj.log.segments import Segment
from dnnmso_mj.reading import Snapshot
from dnnmso_mj.scene import Scene
from dnnmso_mj.trace import StepLayout, Trace
from dnnmso_mj.viewer.arm_picture import stage
from dnnmso_mj.viewer.blueprint import SUMMARY, check_tab, replay_blueprint
from dnnmso_mj.viewer.look import RUN_COLORS, Look, Point
from dnnmso_mj.viewer.stream import RunStream
from dnnmso_mj.viewer.summary import comparison

APPLICATION = "dnnmso"
MOST_RUNS = len(RUN_COLORS)


@dataclass(frozen=True)
class Run:
    """A run to show, of at least one tick.

    Args:
        name: tells it from others beside it.
        trace: its columns.
        scene: its robot.
        snapshots: of its controller.
        segments: which scenario was in force when, where that has changed.
    """

    name: str
    trace: Trace
    scene: Scene
    snapshots: Sequence[Snapshot] = ()
    segments: Sequence[Segment] = ()


def rrd_bytes(
    runs: Sequence[Run], first_tab: str = "Tracking", *, side_by_side: bool = False
) -> bytes:
    """The content of a .rrd file: a run or several, and the layout to see them in.

    It is made in memory, since Rerun's own writer waits for ever on a full disk.

    Args:
        runs: one; or up to eight of robots with as many joints, each then in one colour.
        first_tab: the tab that is open at first, a key of `signals.plot_tabs`.
        side_by_side: whether the arms stand beside one another, and not in one another.

    Raises:
        LogError: there is no such tab, or the runs cannot be shown together.
    """
    recording = rr.RecordingStream(APPLICATION)
    memory = recording.memory_recording()
    if len(runs) == 1:
        stream = _stream(recording, runs[0], "", Look())
        stream.begin(first_tab)
        _send(stream, runs[0])
    else:
        _send_together(recording, runs, first_tab, side_by_side)
    return memory.drain_as_bytes()


def _stream(recording: rr.RecordingStream, run: Run, prefix: str, look: Look) -> RunStream:
    trace = run.trace
    layout = StepLayout(trace.n_joints, trace.n_layers)
    return RunStream(recording, trace.scenario, run.scene, layout, prefix=prefix, look=look)


def _send(stream: RunStream, run: Run) -> None:
    """A whole run that has begun."""
    trace = run.trace
    segments = run.segments or [Segment(0, trace.scenario)]
    ends = [*(segment.first for segment in segments[1:]), len(trace)]
    for segment, end in zip(segments, ends, strict=True):
        columns = {name: trace[name][segment.first : end] for name in trace}
        stream.send(replace(trace, columns=columns, scenario=segment.scenario))
    stream.events(trace.events)
    for snapshot in run.snapshots:
        stream.snapshot(snapshot.t, snapshot.arrays)
    stream.end(trace.info)


def _send_together(
    recording: rr.RecordingStream, runs: Sequence[Run], first_tab: str, side_by_side: bool
) -> None:
    _check(runs)
    looks = _looks(runs, side_by_side)
    streams = [
        _stream(recording, run, f"{rr.escape_entity_path_part(run.name)}/", look)
        for run, look in zip(runs, looks, strict=True)
    ]
    shown = [stream.shown for stream in streams]
    for k, run in enumerate(runs[1:], start=1):
        if _same_events(run, runs[0]):
            shown[k] = replace(shown[k], lanes=shown[k].lanes[:1])
    check_tab(first_tab, shown)
    recording.send_blueprint(replay_blueprint(shown, first_tab))
    recording.send_recording_name(", ".join(run.name for run in runs))
    text = comparison([run.name for run in runs], [run.trace for run in runs])
    document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
    recording.log(SUMMARY, document, static=True)
    for stream, run in zip(streams, runs, strict=True):
        stream.declare()
        _send(stream, run)


def _check(runs: Sequence[Run]) -> None:
    if len(runs) > MOST_RUNS:
        raise LogError(f"{len(runs)} logs; allowed: up to {MOST_RUNS} in one viewer")
    first = runs[0]
    for run in runs:
        n = run.trace.n_joints
        if n != first.trace.n_joints:
            raise LogError(
                f"{run.name} has {n} joints; allowed: {first.trace.n_joints}, as many as "
                f"{first.name}. Replay them one at a time."
            )


def _looks(runs: Sequence[Run], side_by_side: bool) -> list[Look]:
    """A colour for each run; the desired motion once for all that have the same."""
    looks = []
    for k, run in enumerate(runs):
        is_new = not any(_same_motion(run, other) for other in runs[:k])
        offset = _offset(k, runs) if side_by_side else (0.0, 0.0, 0.0)
        ghost = is_new or side_by_side
        looks.append(Look(run.name, RUN_COLORS[k], shared=is_new, ghost=ghost, offset=offset))
    return looks


def _offset(k: int, runs: Sequence[Run]) -> Point:
    """Where arm k stands (m): in rows of up to four, as seen by the camera."""
    apart = 2.0 * max(stage(run.trace.scenario, run.scene)[1] for run in runs)
    abreast = min(len(runs), 4)
    return (k % abreast) * apart, 0.0, -(k // abreast) * apart


def _same_motion(run: Run, other: Run) -> bool:
    """Whether two arms are alike and have the same way to go."""
    a, b = run.trace.scenario, other.trace.scenario
    alike = (a.plant.model, a.plant.lengths) == (b.plant.model, b.plant.lengths)
    return alike and (a.reference, a.duration) == (b.reference, b.duration)


def _same_events(run: Run, other: Run) -> bool:
    a, b = run.trace.scenario, other.trace.scenario
    return (a.events, a.dt) == (b.events, b.dt)
