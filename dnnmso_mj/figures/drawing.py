"""How every figure looks: style, panels, and lines that stay small and lose nothing."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import matplotlib as mpl
import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from dnnmso_mj.trace import Array, Trace

# Okabe and Ito's palette, which colour-blind people can tell apart.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
INK = "#333333"  # references, bounds and limits, drawn dashed
DASHED: Mapping[str, Any] = {"linestyle": (0, (4, 2)), "linewidth": 0.9, "zorder": 4}

_STYLE = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 8,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.limits": (-3, 4),
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.1,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "legend.handlelength": 1.2,
    "legend.columnspacing": 0.8,
    "legend.handletextpad": 0.4,
    "figure.titlesize": 9,
    # Places that follow from no text's size: measuring every text first takes as long as drawing.
    "axes.titley": 1.0,
    "figure.dpi": 150,
}
_SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
# in
_WIDTH = 9.0
_PANEL_HEIGHT = 1.75
_LEFT, _RIGHT, _BOTTOM = 0.72, 0.17, 0.43  # beside panels: tick labels and axis labels
_TITLE, _PANEL_TITLE, _LEGEND_ROW = 0.28, 0.25, 0.17
_LEGEND_WIDTH = 110  # characters beside a title, in a panel as wide as the figure
_BUCKETS = 1_500  # across a figure; one is narrower than a pixel


@contextmanager
def house_style() -> Iterator[None]:
    """Draw and save inside this: the same look whatever the user's matplotlib settings are."""
    with mpl.style.context(_STYLE, after_reset=True):
        yield


def panels(
    count: int, columns: int, title: str, kind: type[Figure] = Figure
) -> tuple[Figure, list[Axes]]:
    """A figure with `count` panels, filled row by row; `arrange` gives them their places."""
    rows = math.ceil(count / columns)
    figure = kind(figsize=(_WIDTH, 0.35 + _PANEL_HEIGHT * rows))
    axes = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for spare in axes[count:]:
        spare.remove()
    if title:
        figure.suptitle(title, x=0.01, y=1.0 - 0.08 / figure.get_figheight(), ha="left")
    return figure, axes[:count]


def arrange(figure: Figure, axes: list[Axes], legend_rows: int = 1) -> None:
    """Put panels and their labels in their places, which follow from the panels' number alone.

    Args:
        figure: of `panels`.
        axes: of `panels`; a row whose panels have no time labels takes less room.
        legend_rows: of the legend above the first panel.
    """
    specification = axes[0].get_subplotspec()
    rows, columns = specification.get_geometry()[:2] if specification else (1, 1)
    more = _LEGEND_ROW * max(0, legend_rows - 1)
    height = figure.get_figheight() + more
    figure.set_figheight(height)
    labelled = axes[0].xaxis.get_tick_params()["labelbottom"]
    gap = _PANEL_TITLE + (_BOTTOM if labelled or rows == 1 else 0.1)
    top = height - _TITLE - _PANEL_TITLE - more
    panel_height = (top - _BOTTOM - gap * (rows - 1)) / rows
    panel_width = (_WIDTH - columns * (_LEFT + _RIGHT)) / columns
    figure.subplots_adjust(
        left=_LEFT / _WIDTH,
        right=1.0 - _RIGHT / _WIDTH,
        bottom=_BOTTOM / height,
        top=top / height,
        wspace=(_LEFT + _RIGHT) / panel_width,
        hspace=gap / panel_height,
    )
    for ax in axes:
        ax.yaxis.set_label_coords((0.15 - _LEFT) / panel_width, 0.5)
        ax.xaxis.set_label_coords(0.5, (0.2 - _BOTTOM) / panel_height)


def envelope(values: Array, buckets: int = _BUCKETS) -> Array:
    """Indices whose points draw the same picture as all points do, in order.

    The smallest and largest of each bucket of ticks, and the first and last point of all: no spike
    is lost, and time and memory do not grow with the run. A line of few points is drawn whole.

    Args:
        values: one line, shape (N,); NaN is a gap.
        buckets: how many, each narrower than a pixel.
    """
    n_ticks = len(values)
    if n_ticks <= 2 * buckets:
        return np.arange(n_ticks)
    size = math.ceil(n_ticks / buckets)
    starts = np.arange(0, n_ticks, size)
    table = np.full((len(starts), size), np.nan)
    table.ravel()[:n_ticks] = values
    gaps = np.isnan(table)
    lowest = starts + np.where(gaps, np.inf, table).argmin(axis=1)
    highest = starts + np.where(gaps, -np.inf, table).argmax(axis=1)
    return np.unique(np.concatenate([[0, n_ticks - 1], lowest, highest]))


def line(axes: Axes, t: Array, values: Array, **how: Any) -> None:
    """Draw values (N,) over t (N,) in seconds."""
    place = axes.get_subplotspec()
    columns = place.get_geometry()[1] if place else 1
    drawn = envelope(values, _BUCKETS // columns)
    axes.plot(t[drawn], values[drawn], **how)


def log_line(axes: Axes, t: Array, values: Array, **how: Any) -> None:
    """Draw the positive values on a logarithmic axis; nothing, not even a legend, without any."""
    positive = values > 0.0
    if positive.any():
        axes.set_yscale("log")
        line(axes, t, np.where(positive, values, np.nan), **{"linewidth": 0.7, **how})


def name_panel(axes: Axes, title: str, x: str, y: str) -> None:
    """Title and axis labels with units; a logarithmic axis gets whole decades."""
    axes.set_title(title)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    if axes.get_yscale() == "log":
        _whole_decades(axes)


def name_time_panel(axes: Axes, span: tuple[float, float], title: str, y: str) -> None:
    """`name_panel` for a panel over the times `span` (s)."""
    axes.set_xlim(*span)
    name_panel(axes, title, "t (s)", y)


def legend_above(axes: Axes) -> int:
    """A legend above the axes, where it hides no data, unless for a single entry; its rows."""
    handles, labels = axes.get_legend_handles_labels()
    entries = dict(zip(labels, handles, strict=True))
    if len(entries) < 2:
        return 0
    longest = max(len(label) for label in entries)
    columns = max(1, min(len(entries), _LEGEND_WIDTH // (longest + 6)))
    axes.legend(
        entries.values(),
        entries.keys(),
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        borderaxespad=0.0,
        ncols=columns,
    )
    return math.ceil(len(entries) / columns)


def span_of(traces: Iterable[Trace]) -> tuple[float, float]:
    """First tick of the first run to the end of the last run's last period (s)."""
    ends = [(float(trace["t"][0]), trace["t"][-1] + trace.scenario.dt) for trace in traces]
    return min(first for first, _ in ends), max(float(last) for _, last in ends)


def subscript(index: int) -> str:
    """An index as plain text: matplotlib's formulas take longer to typeset than lines to draw."""
    return str(index).translate(_SUBSCRIPTS)


def _power_of_ten(value: float, _: float) -> str:
    return "10" + str(round(math.log10(value))).translate(_SUPERSCRIPTS)


def decades(axis: Axis) -> None:
    """Ticks of a logarithmic axis at powers of ten only, written as plain text."""
    axis.set_major_locator(LogLocator(numticks=6))
    axis.set_major_formatter(_power_of_ten)
    axis.set_minor_locator(NullLocator())


def _whole_decades(axes: Axes) -> None:
    """Widen y to powers of ten, so that there are ticks however little the data vary."""
    room = 0.05  # of a decade
    bottom = math.floor(math.log10(axes.dataLim.minposy) - room)
    top = math.ceil(math.log10(axes.dataLim.y1) + room)
    axes.set_ylim(10.0**bottom, 10.0**top)
    decades(axes.yaxis)
