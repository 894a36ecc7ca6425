"""A run on its way into Rerun, a stretch of ticks at a time.

What is shown, and how, is decided by the scenario and the widths of its columns alone: so a run
that still goes on is shown as its log will be.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import rerun as rr

from dnnmso_mj.scenario import Scenario
from dnnmso_mj.scene import Scene
from dnnmso_mj.trace import Array, Event, RunInfo, StepLayout, Trace
from dnnmso_mj.viewer.arm_picture import ArmPicture, stage
from dnnmso_mj.viewer.blueprint import EVENTS, PLOTS, SUMMARY, Shown, check_tab, replay_blueprint
from dnnmso_mj.viewer.heat_maps import HeatMaps
from dnnmso_mj.viewer.lanes import Lanes
from dnnmso_mj.viewer.look import Look
from dnnmso_mj.viewer.plot import THIN, Plot
from dnnmso_mj.viewer.signals import plot_tabs
from dnnmso_mj.viewer.stamps import stamps
from dnnmso_mj.viewer.summary import Metrics, drawable, outcome, summary

_PIXEL = {
    "extremes": rr.components.AggregationPolicy.MinMax,
    "largest": rr.components.AggregationPolicy.Max,
}
_LEVELS = {
    "info": rr.TextLogLevel.INFO,
    "warning": rr.TextLogLevel.WARN,
    "error": rr.TextLogLevel.ERROR,
}


class RunStream:
    """Sends a run: `begin`, then stretches, events and snapshots as they come, then `end`.

    Args:
        recording: where to.
        scenario: the experiment.
        scene: its robot.
        layout: the widths of its columns.
        prefix: what the paths of its entities begin with; "" or a name and "/".
        look: what sets it apart from other runs in the same recording.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        scenario: Scenario,
        scene: Scene,
        layout: StepLayout,
        *,
        prefix: str = "",
        look: Look | None = None,
    ) -> None:
        self.scenario = scenario
        self._prefix = prefix
        self.look = look or Look()
        self._tabs = plot_tabs(scenario, scene, layout)
        self._heat_maps = HeatMaps(recording, scenario, prefix)
        self._recording = recording
        self._scene = scene
        self._plots = [plot for plots in self._tabs.values() for plot in plots]
        if not self.look.shared:
            self._plots = [_unshared(plot) for plot in self._plots]
        self._arm = ArmPicture(recording, scenario, scene, prefix, self.look)
        self._lanes = Lanes(recording, scenario, prefix, self.look)
        self._ticks = 0

    def begin(self, first_tab: str = "Tracking") -> None:
        """Lay out the viewer, and send what needs no data.

        Args:
            first_tab: the tab that is open at first, a key of `signals.plot_tabs`.

        Raises:
            LogError: there is no such tab.
        """
        check_tab(first_tab, [self.shown])
        recording = self._recording
        # Active at once: served, a mere default is lost at times.
        recording.send_blueprint(replay_blueprint([self.shown], first_tab))
        recording.send_recording_name(f"{self.scenario.name}, seed {self.scenario.seed}")
        self.declare()

    def declare(self) -> None:
        """Send what needs no data: styles, shapes, and what the run is."""
        self._recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._arm.begin()
        self._lanes.begin()
        for plot in self._plots:
            self._send_styles(plot)
        self._send_summary("running", {})

    def send(self, trace: Trace) -> None:
        """Send a stretch of ticks: every value of every line, the arm at most every 10 ms.

        Args:
            trace: the columns of the ticks that follow those sent before, and the scenario that was
                in force in them.
        """
        if not len(trace):
            return
        t = trace["t"]
        ticks = np.rint(t / self.scenario.dt).astype(int)
        self._arm.send(t, ticks, trace["q"], trace["q_ref"])
        self._lanes.send(trace, ticks)
        times, ends = stamps(t, ticks), [0, len(t) - 1]
        for plot in self._plots:
            path = self._path(plot)
            values = np.stack([line.values(trace) for line in plot.lines], axis=1)  # (N, lines)
            _send_scalars(self._recording, f"{path}/lines", times, values)
            if plot.levels:
                levels = np.array([[level.value for level in plot.levels]] * 2)  # (2, levels)
                at_ends = stamps(t[ends], ticks[ends])
                _send_scalars(self._recording, f"{path}/levels", at_ends, levels)
        self._ticks = int(ticks[-1]) + 1

    def events(self, events: Sequence[Event]) -> None:
        """Send events, as text."""
        if not events:
            return
        t = np.array([event.t for event in events])
        name = f"{self.look.name}, " if self.look.name else ""
        texts = [drawable(f"{name}{event.t:.3f} s: {event.message}") for event in events]
        columns = rr.TextLog.columns(text=texts, level=[_LEVELS[event.level] for event in events])
        times = stamps(t, np.rint(t / self.scenario.dt).astype(int))
        self._recording.send_columns(self._prefix + EVENTS, times, columns)

    def snapshot(self, t: float, arrays: Mapping[str, Array]) -> None:
        """Send the weights in a controller's state at t (s) as pictures."""
        self._heat_maps.send(t, arrays)

    def end(self, info: RunInfo) -> None:
        """Send how the run went."""
        self._lanes.end(info.status)
        how = outcome(info.status, info.reason, self._ticks * self.scenario.dt)
        self._send_summary(how, info.metrics)

    @property
    def shown(self) -> Shown:
        """What there is to lay out."""
        maps = self._heat_maps
        centre, half_size = stage(self.scenario, self._scene)
        x, y, z = (c + offset for c, offset in zip(centre, self.look.offset, strict=True))
        return Shown(
            name=self.look.name,
            prefix=self._prefix,
            tabs=self._tabs,
            lanes=self._lanes.names,
            matrices=maps.names,
            ratios=[name for name in maps.names if name not in maps.from_zero],
            centre=(x, y, z),
            half_size=half_size,
        )

    def _path(self, plot: Plot) -> str:
        return f"{self._prefix}{PLOTS}/{plot.path}"

    def _send_styles(self, plot: Plot) -> None:
        """The lines of a plot are one entity, its levels another."""
        style = rr.SeriesLines(
            names=[self.look.line_name(line) for line in plot.lines],
            colors=[self.look.line_color(line) for line in plot.lines],
            widths=[line.width for line in plot.lines],
            aggregation_policy=_PIXEL[plot.pixel],
        )
        self._recording.log(f"{self._path(plot)}/lines", style, static=True)
        if plot.levels:
            style = rr.SeriesLines(
                names=[level.name for level in plot.levels],
                colors=[level.color for level in plot.levels],
                widths=[THIN] * len(plot.levels),
            )
            self._recording.log(f"{self._path(plot)}/levels", style, static=True)

    def _send_summary(self, how: str, metrics: Metrics) -> None:
        text = summary(self.scenario, how, metrics)
        document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
        self._recording.log(self._prefix + SUMMARY, document, static=True)


def _unshared(plot: Plot) -> Plot:
    return replace(plot, lines=tuple(line for line in plot.lines if line.role != "shared"))


def _send_scalars(
    recording: rr.RecordingStream, path: str, times: Sequence[rr.TimeColumn], values: Array
) -> None:
    columns = rr.Scalars.columns(scalars=values.ravel()).partition([values.shape[1]] * len(values))
    recording.send_columns(path, times, columns)
