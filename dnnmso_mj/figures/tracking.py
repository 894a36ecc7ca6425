"""Tracking, error and torque of one run, or of several laid over each other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from dnnmso_mj.figures.drawing import (
    COLOURS,
    DASHED,
    INK,
    arrange,
    legend_above,
    line,
    log_line,
    name_time_panel,
    panels,
    span_of,
    subscript,
)
from dnnmso_mj.metrics import worst_error
from dnnmso_mj.scenario import expand
from dnnmso_mj.trace import Array, Trace

Runs = Mapping[str, Trace]  # name in the legend -> run, all with the same number of joints


def tracking_figure(runs: Runs, title: str = "") -> Figure:
    """Joint angles over their references, one panel a joint."""
    figure, axes = _stack(_n_joints(runs), title)
    _draw_joints(axes, runs, "q", "rad", lambda trace: trace["q"])
    for trace in _distinct_references(runs):
        for ax, q_ref in zip(axes, trace["q_ref"].T, strict=True):
            line(ax, trace["t"], q_ref, color=INK, label="reference", **DASHED)
    return _finished(figure, axes)


def error_figure(runs: Runs, title: str = "") -> Figure:
    """Tracking errors q - q_ref, one panel a joint, and the worst joint on a logarithmic axis."""
    figure, axes = _stack(_n_joints(runs) + 1, title)
    _draw_joints(axes[:-1], runs, "e", "rad", lambda trace: trace["q"] - trace["q_ref"])
    for colour, label, trace in _coloured(runs):
        log_line(axes[-1], trace["t"], worst_error(trace), color=colour, label=label)
    name_time_panel(axes[-1], span_of(runs.values()), "Worst joint", "|e| (rad)")
    return _finished(figure, axes)


def torque_figure(runs: Runs, title: str = "") -> Figure:
    """Applied joint torques with the actuators' limits, one panel a joint."""
    figure, axes = _stack(_n_joints(runs), title)
    _draw_joints(axes, runs, "τ", "N·m", lambda trace: trace["tau"])
    for trace in runs.values():
        limits = trace.scenario.imperfections.torque_limit
        for ax, limit in zip(axes, expand(limits, len(axes)) if limits else (), strict=False):
            for bound in (-limit, limit):
                ax.axhline(bound, color=INK, label="limit", **DASHED)
    return _finished(figure, axes)


def _draw_joints(
    axes: list[Axes], runs: Runs, symbol: str, unit: str, signal: Callable[[Trace], Array]
) -> None:
    """One panel for each column of a signal (N, n)."""
    for colour, label, trace in _coloured(runs):
        for ax, values in zip(axes, signal(trace).T, strict=True):
            roughness = float(np.abs(np.diff(values)).sum())
            # A chattering line would cover a smooth one, so the smoother lies on top.
            order = 2.0 + 1.0 / (1.0 + roughness)
            line(ax, trace["t"], values, color=colour, label=label, zorder=order)
    span = span_of(runs.values())
    for i, ax in enumerate(axes, start=1):
        name_time_panel(ax, span, f"Joint {i}", f"{symbol}{subscript(i)} ({unit})")


def _stack(count: int, title: str) -> tuple[Figure, list[Axes]]:
    return panels(count, _columns(count), title)


def _columns(count: int) -> int:
    return 1 if count <= 4 else 2


def _finished(figure: Figure, axes: list[Axes]) -> Figure:
    """One legend for all panels, and time labels only under the last panel of each column."""
    legend_rows = legend_above(axes[0])
    for ax in axes[: -_columns(len(axes))]:
        ax.set_xlabel("")
        ax.tick_params(labelbottom=False)
    arrange(figure, axes, legend_rows)
    return figure


def _n_joints(runs: Runs) -> int:
    return next(iter(runs.values())).n_joints


def _coloured(runs: Runs) -> Iterator[tuple[str, str, Trace]]:
    """The runs with a colour each: of the palette, or shades where it does not suffice."""
    shades = mpl.colormaps["viridis"](np.linspace(0.0, 0.95, len(runs)))
    colours = COLOURS if len(runs) <= len(COLOURS) else [to_hex(shade) for shade in shades]
    for colour, (label, trace) in zip(colours, runs.items(), strict=False):
        yield colour, label, trace


def _distinct_references(runs: Runs) -> list[Trace]:
    """Runs with references of their own: one that a longer run's begins with is drawn once."""
    out: list[Trace] = []
    for trace in sorted(runs.values(), key=len, reverse=True):
        if not any(_begins_with(longer, trace) for longer in out):
            out.append(trace)
    return out


def _begins_with(longer: Trace, trace: Trace) -> bool:
    return all(np.array_equal(longer[name][: len(trace)], trace[name]) for name in ("t", "q_ref"))
