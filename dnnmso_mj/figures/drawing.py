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
    "legend.handlelength": 1.4,
    "legend.columnspacing": 1.0,
    "legend.handletextpad": 0.5,
    "figure.titlesize": 9,
    "figure.dpi": 150,
}
_SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_WIDTH = 9.0  # in
_PANEL_HEIGHT = 1.75  # in
_LEGEND_WIDTH = 110  # characters beside a title, in a panel as wide as the figure
_DRAWN_WHOLE = 6_000  # points of a line; a longer one is drawn by its envelope


@contextmanager
def house_style() -> Iterator[None]:
    """Draw and save inside this: the same look whatever the user's matplotlib settings are."""
    with mpl.style.context(_STYLE, after_reset=True):
        yield


def panels(count: int, columns: int, title: str) -> tuple[Figure, list[Axes]]:
    """A figure with `count` panels, filled row by row."""
    rows = math.ceil(count / columns)
    figure = Figure(figsize=(_WIDTH, 0.35 + _PANEL_HEIGHT * rows), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for spare in axes[count:]:
        spare.remove()
    if title:
        figure.suptitle(title, x=0.01, ha="left")
    return figure, axes[:count]


def envelope(values: Array) -> Array:
    """Indices whose points draw the same picture as all points do, in order.

    The first, smallest, largest and last point of each bucket of ticks, none as wide as a pixel:
    no spike is lost, and time and memory do not grow with the run.

    Args:
        values: one line, shape (N,); NaN is a gap.
    """
    n_ticks = len(values)
    if n_ticks <= _DRAWN_WHOLE:
        return np.arange(n_ticks)
    size = math.ceil(n_ticks / (_DRAWN_WHOLE // 4))
    whole = n_ticks // size * size
    starts = np.arange(0, whole, size)
    buckets = values[:whole].reshape(-1, size)
    gaps = np.isnan(buckets)
    lowest = starts + np.where(gaps, np.inf, buckets).argmin(axis=1)
    highest = starts + np.where(gaps, -np.inf, buckets).argmax(axis=1)
    rest = whole + envelope(values[whole:])
    return np.unique(np.concatenate([starts, lowest, highest, starts + size - 1, rest]))


def line(axes: Axes, t: Array, values: Array, **how: Any) -> None:
    """Draw values (N,) over t (N,) in seconds."""
    drawn = envelope(values)
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


def legend_above(axes: Axes) -> None:
    """A legend above the axes, where it hides no data; none for a single entry."""
    handles, labels = axes.get_legend_handles_labels()
    entries = dict(zip(labels, handles, strict=True))
    if len(entries) > 1:
        longest = max(len(label) for label in entries)
        axes.legend(
            entries.values(),
            entries.keys(),
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            borderaxespad=0.0,
            ncols=max(1, min(len(entries), _LEGEND_WIDTH // (longest + 6))),
        )


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
