"""The viewer's default layout: the arm and the events on the left, tabs of plots on the right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import rerun.blueprint as rrb
from rerun.blueprint.encodings import TimelineColumn

from dnnmso_mj.viewer.signals import TIMELINE, Plot

Point = tuple[float, float, float]

ARM, DESIRED, TRAIL = "arm", "desired", "trail"
PLOTS, EVENTS, SUMMARY = "plots", "events", "summary"

_WIDE = 4  # so many plots or fewer stand above one another; more stand in two columns


def replay_blueprint(
    tabs: Mapping[str, Sequence[Plot]],
    centre: Point,
    half_size: float,
    *,
    events: bool,
    first_tab: str,
) -> rrb.Blueprint:
    """Lay out a replay.

    Args:
        tabs: tab name -> its plots, as `signals.plot_tabs` gives them.
        centre, half_size: what the camera shows (m).
        events: whether there are any.
        first_tab: the tab that is open at first.
    """
    told = [rrb.TextDocumentView(origin=SUMMARY, name="Run"), *([_event_view()] if events else [])]
    left = rrb.Vertical(_arm_view(centre, half_size), rrb.Horizontal(*told), row_shares=[3, 1])
    right = rrb.Tabs(
        *(_tab(name, plots) for name, plots in tabs.items()), active_tab=list(tabs).index(first_tab)
    )
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[2, 3]),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _event_view() -> rrb.TextLogView:
    no_time = TimelineColumn(TIMELINE, visible=False)  # too narrow to read; the body begins with it
    columns = rrb.TextLogColumns(timeline_columns=[no_time], text_log_columns=["LogLevel", "Body"])
    return rrb.TextLogView(origin=EVENTS, name="Events", columns=columns)


def _arm_view(centre: Point, half_size: float) -> rrb.Spatial3DView:
    past = rrb.VisibleTimeRanges(
        timeline=TIMELINE,
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    x, y, z = centre
    return rrb.Spatial3DView(
        origin="/",
        contents=[f"{name}/**" for name in (ARM, DESIRED, TRAIL)],
        name="Arm, and the desired arm as a ghost",
        overrides={f"{TRAIL}/actual": [past]},
        # At this distance the default field of view holds a little more than the half size.
        eye_controls=rrb.EyeControls3D(
            position=(x, y - 2.0 * half_size, z + 0.2 * half_size),
            look_target=centre,
            eye_up=(0.0, 0.0, 1.0),
        ),
        line_grid=rrb.LineGrid3D(visible=False),
    )


def _tab(name: str, plots: Sequence[Plot]) -> rrb.Container:
    views = [_plot_view(plot) for plot in plots]
    if len(views) <= _WIDE:
        return rrb.Vertical(*views, name=name)
    return rrb.Grid(*views, grid_columns=2, name=name)


def _plot_view(plot: Plot) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=f"{PLOTS}/{plot.path}",
        name=plot.title,
        axis_x=rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal),
        axis_y=rrb.ScalarAxis(range=plot.y_range) if plot.y_range else None,
        plot_legend=rrb.PlotLegend(plot.legend),
    )
