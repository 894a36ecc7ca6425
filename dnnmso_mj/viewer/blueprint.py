"""The viewer's layout: the arm and what happens on the left, tabs of plots on the right."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import rerun.blueprint as rrb
from rerun.blueprint.encodings import TimelineColumn

from dnnmso_mj.viewer.look import Point
from dnnmso_mj.viewer.plot import Plot
from dnnmso_mj.viewer.stamps import TIMELINE

ARM, DESIRED, TRAIL = "arm", "desired", "trail"
PLOTS, EVENTS, SUMMARY = "plots", "events", "summary"
WEIGHTS, CHANGE = "weights", "weight_change"

_PANEL = 800.0  # height of a tab in pixels, about
_LANE, _LANES_HEAD = 41.0, 50.0  # pixels
_ABREAST = 5  # so many pictures stand side by side
_LINK = rrb.components.LinkAxis.LinkToGlobal


@dataclass(frozen=True)
class Shown:
    """What there is to lay out of a run.

    Args:
        name: of the run, where there are several.
        prefix: what the paths of its entities begin with.
        tabs: tab name -> its plots, as `signals.plot_tabs` gives them.
        lanes: names of its bands.
        matrices: names of its weight matrices.
        centre, half_size: what the camera must show (m).
    """

    name: str
    prefix: str
    tabs: Mapping[str, Sequence[Plot]]
    lanes: Sequence[str]
    matrices: Sequence[str]
    centre: Point
    half_size: float


def replay_blueprint(runs: Sequence[Shown], first_tab: str) -> rrb.Blueprint:
    """Lay out a run, or several over one another.

    Args:
        runs: one or more.
        first_tab: the tab that is open at first.
    """
    told = rrb.Vertical(_event_view(runs), _summary_view())
    left = rrb.Vertical(_arm_view(runs, "Arm"), told, row_shares=[4, 5])
    names = tab_names(runs)
    right = rrb.Tabs(*(_tab(name, runs) for name in names), active_tab=names.index(first_tab))
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[1, 3]),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def tab_names(runs: Sequence[Shown]) -> list[str]:
    """The tabs of all runs, in the order of that which has most."""
    most = max(runs, key=lambda run: len(run.tabs))
    return list(most.tabs)


def _tab(name: str, runs: Sequence[Shown]) -> rrb.Container:
    """Bands over the plots of a tab, all on one axis of time."""
    lanes = _entities(runs, lambda run: run.lanes)
    height = (_LANES_HEAD + _LANE * len(lanes)) / _PANEL
    bands = rrb.StateTimelineView(
        origin="/", contents=lanes, name="What happens", time_view=rrb.TimeAxis(link=_LINK)
    )
    return rrb.Vertical(bands, _body(name, runs), row_shares=[height, 1.0 - height], name=name)


def _body(name: str, runs: Sequence[Shown]) -> rrb.Container | rrb.View:
    plots = {plot.path: plot for run in runs for plot in run.tabs.get(name, ())}
    views = {path: _plot_view(plot, runs) for path, plot in plots.items()}
    match name:
        case "Scene":
            return _arm_view(runs, "The tip's way so far, and the way it should go")
        case "Learning":
            return _learning(views, runs)
        case "Timing":
            return rrb.Vertical(*views.values())
    return rrb.Grid(*views.values(), grid_columns=2)


def _learning(views: Mapping[str, rrb.View], runs: Sequence[Shown]) -> rrb.Container:
    """The dynamics on the left, the weights on the right."""
    of_weights = [views[path] for path in ("weight_norm", "update_ratio") if path in views]
    left = rrb.Vertical(*(view for view in views.values() if view not in of_weights))
    pictures = [_pictures(run) for run in runs if run.matrices]
    if not of_weights and not pictures:
        return left
    shown = [rrb.Tabs(*pictures)] if len(pictures) > 1 else pictures
    shares = [1] * len(of_weights) + [2] * len(shown)
    return rrb.Horizontal(left, rrb.Vertical(*of_weights, *shown, row_shares=shares))


def _pictures(run: Shown) -> rrb.Container:
    rows = [
        rrb.Grid(
            *(_picture(f"{run.prefix}{root}/{name}", title.format(name)) for name in run.matrices),
            grid_columns=min(len(run.matrices), _ABREAST),
        )
        for root, title in ((WEIGHTS, "{}"), (CHANGE, "log₁₀|{0}/{0} at first|"))
    ]
    return rrb.Vertical(*rows, name=run.name or None)


def _picture(path: str, title: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(origin=path, name=title)


def _summary_view() -> rrb.TextDocumentView:
    return rrb.TextDocumentView(origin=SUMMARY, name="Run")


def _event_view(runs: Sequence[Shown]) -> rrb.TextLogView:
    no_time = TimelineColumn(TIMELINE, visible=False)  # too narrow to read; the body begins with it
    columns = rrb.TextLogColumns(timeline_columns=[no_time], text_log_columns=["LogLevel", "Body"])
    contents = _entities(runs, lambda run: [EVENTS])
    return rrb.TextLogView(origin="/", contents=contents, name="Events", columns=columns)


def _arm_view(runs: Sequence[Shown], name: str) -> rrb.Spatial3DView:
    past = rrb.VisibleTimeRanges(
        timeline=TIMELINE,
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    roots = _entities(runs, lambda run: (ARM, DESIRED, TRAIL))
    (x, y, z), half_size = _stage(runs)
    return rrb.Spatial3DView(
        origin="/",
        contents=[f"{root}/**" for root in roots],
        name=name,
        overrides={f"{run.prefix}{TRAIL}/actual": [past] for run in runs},
        # At this distance the default field of view holds a little more than the half size.
        eye_controls=rrb.EyeControls3D(
            position=(x, y - 2.0 * half_size, z + 0.2 * half_size),
            look_target=(x, y, z),
            eye_up=(0.0, 0.0, 1.0),
        ),
        line_grid=rrb.LineGrid3D(visible=False),
    )


def _stage(runs: Sequence[Shown]) -> tuple[Point, float]:
    """Centre and half size (m) of what holds the stages of all runs."""
    lows = [[c - run.half_size for c in run.centre] for run in runs]
    highs = [[c + run.half_size for c in run.centre] for run in runs]
    ends = [
        (min(low), max(high))
        for low, high in zip(zip(*lows, strict=True), zip(*highs, strict=True), strict=True)
    ]
    x, y, z = ((low + high) / 2 for low, high in ends)
    return (x, y, z), max((high - low) / 2 for low, high in ends)


def _plot_view(plot: Plot, runs: Sequence[Shown]) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin="/",
        contents=[f"{root}/**" for root in _entities(runs, lambda run: [f"{PLOTS}/{plot.path}"])],
        name=plot.title,
        axis_x=rrb.TimeAxis(link=_LINK),
        axis_y=rrb.ScalarAxis(range=plot.y_range) if plot.y_range else None,
        plot_legend=rrb.PlotLegend(plot.legend),
    )


def _entities(runs: Sequence[Shown], names: Callable[[Shown], Iterable[str]]) -> list[str]:
    return [f"{run.prefix}{name}" for run in runs for name in names(run)]
