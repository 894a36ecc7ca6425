"""A run at one look: angles, errors and torques, as a figure that notebooks show."""

from __future__ import annotations

import io

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dnnmso_mj.figures.drawing import (
    COLOURS,
    DASHED,
    INK,
    arrange,
    house_style,
    legend_above,
    line,
    log_line,
    name_time_panel,
    panels,
    span_of,
)
from dnnmso_mj.metrics import worst_error
from dnnmso_mj.trace import Trace


class NotebookFigure(Figure):
    """A figure that a notebook shows where a cell ends with it, with no backend set up."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        with house_style():
            self.savefig(buffer, format="png")
        return buffer.getvalue()


def overview_figure(trace: Trace, title: str) -> Figure:
    """Angles over their references, the worst joint's error on a logarithmic axis, and torques."""
    span = span_of([trace])
    with house_style():
        figure, axes = panels(3, 1, title, NotebookFigure)
        angles, error, torques = axes
        _draw_angles(angles, trace)
        name_time_panel(angles, span, "Joint angles", "q (rad)")
        log_line(error, trace["t"], worst_error(trace), color=INK)
        name_time_panel(error, span, "Error of the worst joint", "|e| (rad)")
        _draw_torques(torques, trace)
        name_time_panel(torques, span, "Torques", "τ (N·m)")
        rows = legend_above(angles)
        for ax in axes[:-1]:
            ax.set_xlabel("")
            ax.tick_params(labelbottom=False)
        arrange(figure, axes, rows)
    return figure


def _draw_angles(axes: Axes, trace: Trace) -> None:
    for i, q in enumerate(trace["q"].T):
        line(axes, trace["t"], q, color=_colour(i), label=f"joint {i + 1}")
    for q_ref in trace["q_ref"].T:
        line(axes, trace["t"], q_ref, color=INK, label="reference", **DASHED)


def _draw_torques(axes: Axes, trace: Trace) -> None:
    roughness = np.abs(np.diff(trace["tau"], axis=0)).sum(axis=0)
    for i, tau in enumerate(trace["tau"].T):
        # A chattering line would cover a smooth one, so the smoother lies on top.
        order = 2.0 + 1.0 / (1.0 + float(roughness[i]))
        line(axes, trace["t"], tau, color=_colour(i), zorder=order)
    for limit in trace.scenario.imperfections.torque_limit or ():
        for bound in (-limit, limit):
            axes.axhline(bound, color=INK, **DASHED)


def _colour(joint: int) -> str:
    return COLOURS[joint % len(COLOURS)]
