"""The figure of an audit: what each frozen model is worth, and a map of what it knows."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure, SubFigure

from dnnmso_mj.audit.portrait import Portrait, Slice
from dnnmso_mj.audit.run import Audit
from dnnmso_mj.audit.summary import AuditPoint
from dnnmso_mj.figures.drawing import COLOURS, DASHED, INK, house_style, name_panel, subscript

Array = np.ndarray

_WIDTH = 10.0  # in
_SUMMARY_HEIGHT, _TITLE_HEIGHT, _MAP_HEIGHT = 2.9, 0.3, 2.0
_LOWEST = -2.0  # of knowledge; what is below is drawn there as a triangle
_BLUE, _RED, _GREEN, _PINK, _ORANGE, _SKY = COLOURS
_KNOWLEDGE = {
    "knowledge_visited": ("visited", _BLUE, "o"),
    "knowledge_near": ("inside", _GREEN, "s"),
    "knowledge_outside": ("outside", _RED, "D"),
}
_ERRORS = {
    "same_alone": ("same trajectory", _BLUE, "o"),
    "same_fed": ("with feed-forward", _SKY, "o"),
    "same_none": ("same, no model", _BLUE, "_"),
    "inside": ("unseen, inside", _GREEN, "s"),
    "inside_none": ("inside, no model", _GREEN, "_"),
    "outside": ("unseen, outside", _RED, "D"),
    "outside_none": ("outside, no model", _RED, "_"),
}
Styles = Mapping[str, tuple[str, str, str]]


def audit_png(audit: Audit) -> bytes:
    """The figure as a PNG."""
    with house_style():
        figure = audit_figure(audit)
        buffer = io.BytesIO()
        FigureCanvasAgg(figure)
        figure.savefig(buffer, format="png")
    return buffer.getvalue()


def audit_figure(audit: Audit) -> Figure:
    """Knowledge and error at every freeze time above, two rows of maps a controller below."""
    rows = [len(portrait.slices) for portrait in audit.portraits]
    heights = [_SUMMARY_HEIGHT, *(_TITLE_HEIGHT + _MAP_HEIGHT * count for count in rows)]
    figure = Figure(figsize=(_WIDTH, sum(heights)), layout="constrained")
    grid = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)
    parts: list[SubFigure] = list(grid.ravel())
    seeds = len(audit.plan.seeds)
    of = "1 seed" if seeds == 1 else f"{seeds} seeds, median and its 95 % interval"
    parts[0].suptitle(f"{audit.plan.name}: weights frozen, {of}", x=0.01, ha="left")
    left, right = parts[0].subplots(1, 2)
    _draw_points(left, audit.points, _KNOWLEDGE)
    left.set_title("knowledge: 1 − RMS(f − f̂)/RMS(f)")
    _limit_knowledge(left)
    _draw_points(right, audit.points, _ERRORS)
    right.set_yscale("log")
    right.set_title("RMSE with frozen weights (rad)")
    for part, portrait in zip(parts[1:], audit.portraits, strict=True):
        _draw_portrait(part, portrait)
    return figure


def _draw_points(axes: Axes, points: Sequence[AuditPoint], styles: Styles) -> None:
    """Each measure of each controller and time, side by side; controllers apart from each other."""
    spread = np.linspace(-0.3, 0.3, len(styles))
    for shift, (name, (label, colour, marker)) in zip(spread, styles.items(), strict=True):
        values = [point.measures[name] for point in points]
        x = np.arange(len(points)) + shift
        # A median of None, where all have diverged, is not drawn.
        y = np.array([np.nan if v.median is None else v.median for v in values])
        hidden = y < _LOWEST
        how: dict[str, Any] = {"color": colour, "linestyle": "none", "markersize": 4}
        axes.plot(x[~hidden], y[~hidden], marker=marker, label=label, **how)
        axes.plot(x[hidden], np.full(hidden.sum(), _LOWEST), marker="v", fillstyle="none", **how)
        for place, value in zip(x, values, strict=True):
            if value.ci_low is not None and value.ci_high is not None:
                axes.plot([place, place], [value.ci_low, value.ci_high], color=colour, linewidth=1)
    _label_points(axes, points)
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.22), ncols=3, borderaxespad=0.0)


def _label_points(axes: Axes, points: Sequence[AuditPoint]) -> None:
    names = list(dict.fromkeys(point.controller for point in points))
    each = len(points) // len(names)
    axes.set_xticks(range(len(points)), [f"{point.at:g} s" for point in points])
    axes.grid(False, axis="x")
    for k, name in enumerate(names):
        middle = k * each + (each - 1) / 2.0
        at = (middle, -0.13)
        axes.annotate(name, at, xycoords=("data", "axes fraction"), ha="center", va="top")
        if k:
            axes.axvline(k * each - 0.5, color=INK, linewidth=0.5)
    axes.set_xlim(-0.6, len(points) - 0.4)


def _limit_knowledge(axes: Axes) -> None:
    """0 and 1 in sight, and what is far below zero at the edge."""
    low, _ = axes.get_ylim()
    axes.set_ylim(max(low, _LOWEST - 0.15), 1.05)
    for level in (0.0, 1.0):
        axes.axhline(level, color=INK, **DASHED)


def _draw_portrait(part: SubFigure, portrait: Portrait) -> None:
    title = f"{portrait.controller}, frozen at {portrait.at:g} s, seed {portrait.seed}"
    part.suptitle(title, x=0.01, ha="left")
    rows = part.subplots(len(portrait.slices), 4, squeeze=False, width_ratios=[1, 1, 1, 1.25])
    for k, (panels, cut) in enumerate(zip(rows, portrait.slices, strict=True)):
        _draw_maps(panels[:3], cut, portrait.visited, k)
        _draw_visit(panels[3], portrait, k)


def _draw_maps(panels: Sequence[Axes], cut: Slice, visited: Array, joint: int) -> None:
    """True and learned acceleration of one joint, on one scale; the error of all joints."""
    true, learned = cut.f_true[..., joint], cut.f_hat[..., joint]
    error = np.linalg.norm(cut.f_true - cut.f_hat, axis=-1)
    most = float(np.abs(true).max()) or 1.0
    largest = float(np.linalg.norm(cut.f_true, axis=-1).max()) or 1.0
    n = cut.f_true.shape[-1]
    x, y = (_coordinate(axis, n) for axis in cut.axes)
    i = subscript(joint + 1)
    signed: dict[str, Any] = {"cmap": "RdBu_r", "vmin": -most, "vmax": most}
    for axes, values, title in ((panels[0], true, f"true f{i}"), (panels[1], learned, f"f̂{i}")):
        mesh = _draw_map(axes, cut, values, visited, **signed)
        name_panel(axes, f"{title} (rad/s²)", x, y)
        _colour_bar(axes, mesh)
    mesh = _draw_map(panels[2], cut, error, visited, cmap="viridis", vmin=0.0, vmax=largest)
    name_panel(panels[2], "|f − f̂| (rad/s²)", x, y)
    _colour_bar(panels[2], mesh)


def _draw_map(axes: Axes, cut: Slice, values: Array, visited: Array, **how: Any) -> QuadMesh:
    mesh = axes.pcolormesh(cut.x, cut.y, values, shading="nearest", rasterized=True, **how)
    i, j = cut.axes
    axes.plot(visited[:, i], visited[:, j], color="white", linewidth=2.2)
    axes.plot(visited[:, i], visited[:, j], color="black", linewidth=1.0)
    axes.set_xlim(cut.x[0], cut.x[-1])
    axes.set_ylim(cut.y[0], cut.y[-1])
    axes.grid(False)
    return mesh


def _colour_bar(axes: Axes, mesh: QuadMesh) -> None:
    bar = axes.figure.colorbar(mesh, ax=axes, extend="both", fraction=0.06, pad=0.03)
    bar.outline.set_linewidth(0.4)
    bar.ax.tick_params(labelsize=6)


def _draw_visit(axes: Axes, portrait: Portrait, joint: int) -> None:
    i = subscript(joint + 1)
    true, learned = portrait.f_true[:, joint], portrait.f_hat[:, joint]
    axes.plot(portrait.t, learned, color=_RED, label=f"f̂{i}")
    axes.plot(portrait.t, true, color=INK, label=f"f{i}", **DASHED)
    name_panel(axes, f"f{i} (dashed) and f̂{i}, visited", "t (s)", "rad/s²")


def _coordinate(axis: int, n: int) -> str:
    i = subscript(axis % n + 1)
    return f"q{i} (rad)" if axis < n else f"q̇{i} (rad/s)"
