"""How values spread over seeds, group by group, and margins as intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from dnnmso_mj.figures.drawing import COLOURS, DASHED, INK
from dnnmso_mj.trace import Array

WIDTH = 9.0  # in
ROW_HEIGHT = 0.36  # in, of a group
LONGEST_LABEL = 40  # characters
LOG_FROM = 30.0  # largest over smallest value from which an axis is logarithmic
# largest over smallest value, ticks in each decade of such an axis
TICKS = (
    (10.0, (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)),
    (3e3, (1.0, 2.0, 5.0)),
    (np.inf, (1.0,)),
)
ROOM = 1.6  # factor between the outermost bar and the end of its axis
STRIP = 0.26  # half height of a strip of points, of the distance between two groups


def spread_figure(
    groups: Mapping[str, Array], x: str, *, title: str = "", mark: float | None = None
) -> Figure:
    """Every value as a point, a box from quartile to quartile, and the median, a row a group.

    Args:
        groups: label -> finite values (k,).
        x: the axis' label, with its unit.
        title: of the panel.
        mark: where a dashed line stands.
    """
    figure, axes = _rows(list(groups), title)
    rng = np.random.default_rng(0)  # of the points' heights alone
    for k, values in enumerate(groups.values()):
        if values.size == 0:
            axes.annotate(
                " no value",
                (0.0, k),
                xycoords=("axes fraction", "data"),
                va="center",
                color=INK,
            )
            continue
        heights = k + rng.uniform(-STRIP, STRIP, values.size)
        size = 9.0 if values.size <= 200 else 2.5
        axes.scatter(values, heights, s=size, color=COLOURS[0], alpha=0.45, linewidths=0)
        low, middle, high = np.percentile(values, [25.0, 50.0, 75.0])
        axes.barh(k, high - low, 2 * STRIP, left=low, fill=False, edgecolor=INK, linewidth=0.9)
        axes.plot([middle, middle], [k - STRIP, k + STRIP], color=COLOURS[1], linewidth=2.0)
    shown = np.concatenate([*groups.values(), [] if mark is None else [mark]])
    if mark is not None:
        axes.axvline(mark, color=INK, **DASHED)
    if shown.size and shown.min() > 0.0 and shown.max() > LOG_FROM * shown.min():
        _logarithmic(axes, shown.max() / shown.min())
    axes.set_xlabel(x)
    return figure


@dataclass(frozen=True)
class Interval:
    """A bar of `interval_figure`; None where there is nothing to draw.

    Args:
        label: of its row.
        middle, low, high: the median and its interval; low and high None: too few values for one.
        text: beside the bar.
        strong: whether it is drawn in the accent colour.
    """

    label: str
    middle: float | None
    low: float | None
    high: float | None
    text: str
    strong: bool


def interval_figure(
    bars: Sequence[Interval], x: str, ends: tuple[float, float], *, title: str = ""
) -> Figure:
    """Medians with their intervals on a logarithmic axis, a row a bar.

    Args:
        bars: from top to bottom.
        x: the axis' label, with its unit.
        ends: left and right, beyond which nothing is drawn: a cross at the end stands for what
            lies outside. The axis is no longer than the bars need.
        title: of the panel.
    """
    figure, axes = _rows([bar.label for bar in bars], title)
    ends = _near(bars, ends)
    low_end, high_end = sorted(ends)
    _logarithmic(axes, high_end / low_end)
    axes.set_xlim(*ends)
    for k, bar in enumerate(bars):
        colour = COLOURS[1] if bar.strong else COLOURS[0]
        if bar.middle is not None:
            middle = float(np.clip(bar.middle, low_end, high_end))
            if bar.low is not None and bar.high is not None:
                low, high = np.clip([bar.low, bar.high], low_end, high_end)
                axes.barh(k, high - low, 0.34, left=low, color=colour, alpha=0.35)
            marker = "o" if middle == bar.middle else "x"
            axes.plot([middle], [k], marker=marker, markersize=5.0, color=colour, clip_on=False)
        axes.annotate(
            bar.text,
            (1.01, k),
            xycoords=("axes fraction", "data"),
            va="center",
            annotation_clip=False,
        )
    axes.set_xlabel(x)
    return figure


def _rows(labels: Sequence[str], title: str) -> tuple[Figure, Axes]:
    """A panel with a labelled row for each group, the first at the top."""
    height = 0.75 + ROW_HEIGHT * max(1, len(labels))
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    axes = figure.add_subplot()
    axes.set_yticks(range(len(labels)), [_label(text) for text in labels])
    axes.use_sticky_edges = False  # room beside the outermost bar
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)
    axes.set_title(_plain(title))
    return figure, axes


def _near(bars: Sequence[Interval], ends: tuple[float, float]) -> tuple[float, float]:
    """Ends of an axis around what the bars show, in the direction of `ends` and not beyond."""
    low, high = sorted(ends)
    shown = [v for bar in bars for v in (bar.low, bar.middle, bar.high) if v is not None]
    inside = [value for value in shown if low <= value <= high]
    if not inside:
        return ends
    near = max(low, min(inside) / ROOM), min(high, max(inside) * ROOM)
    return near if ends[0] < ends[1] else near[::-1]


def _logarithmic(axes: Axes, span: float) -> None:
    """A logarithmic axis with ticks in plain text, fewer a decade the more decades there are."""
    axes.set_xscale("log")
    subs = next(subs for most, subs in TICKS if span < most)
    axes.xaxis.set_major_locator(LogLocator(subs=subs, numticks=15))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_minor_locator(NullLocator())


def _label(text: str) -> str:
    half = LONGEST_LABEL // 2
    return _plain(text if len(text) <= LONGEST_LABEL else f"{text[:half]}…{text[1 - half :]}")


def _plain(text: str) -> str:
    """Not as a formula."""
    return text.replace("$", r"\$")
