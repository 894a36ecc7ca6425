"""A run as a Rerun recording: the moving arm, every plot's lines, the events and a summary."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np
import rerun as rr

from dnnmso_mj.errors import LogError
from dnnmso_mj.scene import Scene
from dnnmso_mj.trace import Array, Event, Trace
from dnnmso_mj.viewer.arm_picture import send_arms, stage
from dnnmso_mj.viewer.blueprint import EVENTS, PLOTS, SUMMARY, replay_blueprint
from dnnmso_mj.viewer.signals import THIN, TIMELINE, Plot, plot_tabs

APPLICATION = "dnnmso"
TICKS = "tick"
POSE_PERIOD = 0.01  # s, at least, between two poses of the arm: eyes need no more
# Tried out: these and no others are known to be in the viewer's font.
_NOT_DRAWN = re.compile("[^\n -\u0148\u014a-\u017f\u0300-\u03de–—‘’“”…−‖⁻¹₀₁₂₃→⇒≤≥√∞≈≠∑∫]")
_PIXEL = {
    "extremes": rr.components.AggregationPolicy.MinMax,
    "largest": rr.components.AggregationPolicy.Max,
}
_LEVELS = {
    "info": rr.TextLogLevel.INFO,
    "warning": rr.TextLogLevel.WARN,
    "error": rr.TextLogLevel.ERROR,
}


def rrd_bytes(trace: Trace, scene: Scene, first_tab: str = "Tracking") -> bytes:
    """The content of a .rrd file: a run, and the layout to see it in.

    Every tick of every line that a plot shows is in it; the arm at most every 10 ms. It is made in
    memory, since Rerun's own writer waits for ever on a full disk.

    Args:
        trace: the run, of at least one tick.
        scene: the robot it is a run of.
        first_tab: the tab that is open at first, a key of `signals.plot_tabs`.

    Raises:
        LogError: there is no such tab.
    """
    tabs = plot_tabs(trace)
    if first_tab not in tabs:
        raise LogError(f"tab {first_tab!r}; this run has: {', '.join(tabs)}")
    stride = max(1, math.ceil(POSE_PERIOD / trace.scenario.dt - 1e-9))
    ticks = np.arange(0, len(trace), stride)
    q, q_ref = trace["q"][ticks], trace["q_ref"][ticks]
    centre, half_size = stage(scene, q, q_ref)
    has_events = bool(trace.events)
    layout = replay_blueprint(tabs, centre, half_size, events=has_events, first_tab=first_tab)
    recording = rr.RecordingStream(APPLICATION)
    memory = recording.memory_recording()
    recording.send_blueprint(layout)  # active at once: served, a mere default is lost at times
    recording.send_recording_name(f"{trace.scenario.name}, seed {trace.info.seed}")
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    send_arms(recording, scene, _times(trace["t"][ticks], ticks), q, q_ref)
    for plot in (plot for plots in tabs.values() for plot in plots):
        _send_plot(recording, plot, trace["t"])
    if trace.events:
        _send_events(recording, trace.events, trace.scenario.dt)
    summary = rr.TextDocument(_summary(trace), media_type=rr.MediaType.MARKDOWN)
    recording.log(SUMMARY, summary, static=True)
    return memory.drain_as_bytes()


def _send_plot(recording: rr.RecordingStream, plot: Plot, t: Array) -> None:
    """The lines of a plot as one entity, a column each; its levels as another, of two points."""
    path = f"{PLOTS}/{plot.path}"
    style = rr.SeriesLines(
        names=[line.name for line in plot.lines],
        colors=[line.color for line in plot.lines],
        widths=[line.width for line in plot.lines],
        aggregation_policy=_PIXEL[plot.pixel],
    )
    recording.log(f"{path}/lines", style, static=True)
    values = np.stack([line.values for line in plot.lines], axis=1)  # (N, lines)
    _send_scalars(recording, f"{path}/lines", _times(t, np.arange(len(t))), values)
    if not plot.levels:
        return
    style = rr.SeriesLines(
        names=[level.name for level in plot.levels],
        colors=[level.color for level in plot.levels],
        widths=[THIN] * len(plot.levels),
    )
    recording.log(f"{path}/levels", style, static=True)
    ends = np.array([0, len(t) - 1])
    levels = np.array([[level.value for level in plot.levels]] * 2)  # (2, levels)
    _send_scalars(recording, f"{path}/levels", _times(t[ends], ends), levels)


def _send_scalars(
    recording: rr.RecordingStream, path: str, times: Sequence[rr.TimeColumn], values: Array
) -> None:
    columns = rr.Scalars.columns(scalars=values.ravel()).partition([values.shape[1]] * len(values))
    recording.send_columns(path, times, columns)


def _send_events(recording: rr.RecordingStream, events: Sequence[Event], dt: float) -> None:
    t = np.array([event.t for event in events])
    texts = [_drawable(f"{event.t:.3f} s: {event.message}") for event in events]
    columns = rr.TextLog.columns(text=texts, level=[_LEVELS[event.level] for event in events])
    recording.send_columns(EVENTS, _times(t, np.round(t / dt).astype(int)), columns)


def _times(t: Array, ticks: Array) -> list[rr.TimeColumn]:
    return [rr.TimeColumn(TIMELINE, duration=t), rr.TimeColumn(TICKS, sequence=ticks)]


def _summary(trace: Trace) -> str:
    """How the run went, in Markdown."""
    info, scenario = trace.info, trace.scenario
    outcome = f"{info.status}: {info.reason}" if info.reason else info.status
    title = f"**{scenario.name}**, seed {info.seed}, {len(trace) * scenario.dt:g} s: {outcome}"
    metrics = [
        f"- {name}: {value:.4g}" for name, value in info.metrics.items() if value is not None
    ]
    return _drawable("\n\n".join(filter(None, [title, scenario.description, "\n".join(metrics)])))


def _drawable(text: str) -> str:
    """Text without the characters that would end a headless viewer; see `signals`."""
    return _NOT_DRAWN.sub("?", text)
