"""The viewer's layout: the arm and what happens on the left, tabs of plots on the right."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import rerun.blueprint as rrb
from rerun.blueprint.encodings import TimelineColumn

from dnnmso_mj.errors import LogError
from dnnmso_mj.viewer.look import Point
from dnnmso_mj.viewer.plot import TIMELINE, Plot

ARM, DESIRED, TRAIL = "arm", "desired", "trail"
WAYS = ("actual", "desired")
PLOTS, EVENTS, SUMMARY = "plots", "events", "summary"
WEIGHTS, RATIOS = "weights", "weight_ratios"

_PANEL = 740.0  # height of a tab in pixels, about
_LANE, _LANES_HEAD = 41.0, 22.0  # pixels
_ABREAST = 5  # so many pictures stand side by side
_MOST_LANES = 6  # more must do with the room of so many
_LINK = rrb.components.LinkAxis.LinkToGlobal

View = rrb.View | rrb.Container
Column = list[tuple[View, float]]  # views and their shares of the height


@dataclass(frozen=True)
class Shown:
    """What there is to lay out of a run.

    Args:
        name: of the run, where there are several.
        prefix: what the paths of its entities begin with.
        tabs: tab name -> its plots, as `signals.plot_tabs` gives them.
        lanes: names of its bands.
        matrices, ratios: names of its weight matrices, and of those whose change is shown.
        centre, half_size: what the camera must show (m).
    """

    name: str
    prefix: str
    tabs: Mapping[str, Sequence[Plot]]
    lanes: Sequence[str]
    matrices: Sequence[str]
    ratios: Sequence[str]
    centre: Point
    half_size: float


def replay_blueprint(runs: Sequence[Shown], first_tab: str) -> rrb.Blueprint:
    """Lay out a run, or several over one another.

    Args:
        runs: one or more.
        first_tab: the tab that is open at first.
    """
    told = (_event_view(runs), _summary_view(runs))
    left = rrb.Vertical(_arm_view(runs, "Arm", aspect=1.0), *told, row_shares=[8, 4, 7])
    names = _tab_names(runs)
    right = rrb.Tabs(*(_tab(name, runs) for name in names), active_tab=names.index(first_tab))
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[1, 3]),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def check_tab(name: str, runs: Sequence[Shown]) -> None:
    """Refuse a tab that there is not.

    Raises:
        LogError: it is none of those of the runs.
    """
    if name not in _tab_names(runs):
        raise LogError(f"tab {name!r}; allowed here: {', '.join(_tab_names(runs))}")


def _tab_names(runs: Sequence[Shown]) -> list[str]:
    """The tabs of all runs, in the order of that which has most."""
    most = max(runs, key=lambda run: len(run.tabs))
    return list(most.tabs)


def _tab(name: str, runs: Sequence[Shown]) -> rrb.Container:
    """The plots of a tab in columns, each under the bands of what happens meanwhile."""
    views: dict[str, View] = {}
    for plot in (plot for run in runs for plot in run.tabs.get(name, ())):
        views.setdefault(plot.path, _plot_view(plot, runs))
    match name:
        case "Scene":
            arm = _arm_view(runs, "The way of the tip, and the way it should go", aspect=2.0)
            columns = [[(arm, 3.0), *_evenly(views.values())]]
        case "Learning":
            columns = _learning(views, runs)
        case "Timing":
            columns = [_evenly(views.values())]
        case _:
            two = list(views.values())
            columns = [_evenly(two[0::2]), _evenly(two[1::2])] if len(two) > 2 else [_evenly(two)]
    return rrb.Horizontal(*(_column(column, runs) for column in columns if column), name=name)


def _evenly(views: Iterable[View]) -> Column:
    return [(view, 1.0) for view in views]


def _learning(views: Mapping[str, View], runs: Sequence[Shown]) -> list[Column]:
    """The dynamics on the left, the weights on the right."""
    of_weights = [views[path] for path in ("weight_norm", "update_ratio") if path in views]
    left = _evenly(view for view in views.values() if view not in of_weights)
    right, pictures = _evenly(of_weights), [_pictures(run) for run in runs if run.matrices]
    if len(pictures) == 1:
        right.append((pictures[0], 2.0))
    elif pictures:
        right.append((rrb.Tabs(*pictures), 2.0))
    return [left, right]


def _column(views: Column, runs: Sequence[Shown]) -> rrb.Container:
    """Views over one another on one axis of time, with shares of the height."""
    lanes = _entities(runs, lambda run: run.lanes)
    bands = rrb.StateTimelineView(
        origin="/",
        contents=lanes,
        name="What happens",
        titlebar=False,
        time_view=rrb.TimeAxis(link=_LINK),
    )
    height = (_LANES_HEAD + _LANE * min(len(lanes), _MOST_LANES)) / _PANEL
    left = (1.0 - height) / sum(share for _, share in views)
    shares = [height, *(left * share for _, share in views)]
    return rrb.Vertical(bands, *(view for view, _ in views), row_shares=shares)


def _pictures(run: Shown) -> rrb.Container:
    """The weights, and under them how each has changed."""
    rows = [
        [_picture(f"{run.prefix}{WEIGHTS}/{name}", name) for name in run.matrices],
        [_picture(f"{run.prefix}{RATIOS}/{name}", "ratio") for name in run.ratios],
    ]
    grids = [rrb.Grid(*row, grid_columns=min(len(row), _ABREAST)) for row in rows if row]
    return rrb.Vertical(*grids, name=run.name or None)


def _picture(path: str, title: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(origin=path, name=title)


def _summary_view(runs: Sequence[Shown]) -> rrb.TextDocumentView:
    return rrb.TextDocumentView(origin=SUMMARY, name="Run" if len(runs) == 1 else "Runs")


def _event_view(runs: Sequence[Shown]) -> rrb.TextLogView:
    no_time = TimelineColumn(TIMELINE, visible=False)  # too narrow to read; the body begins with it
    columns = rrb.TextLogColumns(timeline_columns=[no_time], text_log_columns=["LogLevel", "Body"])
    contents = _entities(runs, lambda run: [EVENTS])
    return rrb.TextLogView(origin="/", contents=contents, name="Events", columns=columns)


def _arm_view(runs: Sequence[Shown], name: str, aspect: float) -> rrb.Spatial3DView:
    """The arms and the ways of their tips, in a view so many times as wide as high."""
    past = rrb.VisibleTimeRanges(
        timeline=TIMELINE,
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    roots = _entities(runs, lambda run: (ARM, DESIRED, TRAIL))
    (x, y, z), half_size = _stage(runs, aspect)
    return rrb.Spatial3DView(
        origin="/",
        contents=[f"{root}/**" for root in roots],
        name=name,
        overrides={f"{run.prefix}{TRAIL}/{way}": [past] for run in runs for way in WAYS},
        # At this distance the default field of view holds a little more than the half size.
        eye_controls=rrb.EyeControls3D(
            position=(x, y - 2.0 * half_size, z + 0.2 * half_size),
            look_target=(x, y, z),
            eye_up=(0.0, 0.0, 1.0),
        ),
        line_grid=rrb.LineGrid3D(visible=False),
    )


def _stage(runs: Sequence[Shown], aspect: float) -> tuple[Point, float]:
    """Centre and half height (m) of what holds the stages of all runs."""
    centre, half = [], []
    for axis in range(3):
        low = min(run.centre[axis] - run.half_size for run in runs)
        high = max(run.centre[axis] + run.half_size for run in runs)
        centre.append((low + high) / 2)
        half.append((high - low) / 2)
    x, y, z = centre
    return (x, y, z), max(half[0] / aspect, half[1] / aspect, half[2])


def _plot_view(plot: Plot, runs: Sequence[Shown]) -> rrb.TimeSeriesView:
    like = [other for run in runs for others in run.tabs.values() for other in others]
    ranges = {other.y_range for other in like if other.path == plot.path}
    y_range = ranges.pop() if len(ranges) == 1 else None
    return rrb.TimeSeriesView(
        origin="/",
        contents=[f"{root}/**" for root in _entities(runs, lambda run: [f"{PLOTS}/{plot.path}"])],
        name=plot.title,
        axis_x=rrb.TimeAxis(link=_LINK),
        axis_y=rrb.ScalarAxis(range=y_range) if y_range else None,
        plot_legend=rrb.PlotLegend(plot.legend, visible=plot.legend is not None),
    )


def _entities(runs: Sequence[Shown], names: Callable[[Shown], Iterable[str]]) -> list[str]:
    return [f"{run.prefix}{name}" for run in runs for name in names(run)]
