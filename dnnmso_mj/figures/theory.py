"""What the network learned, and what the theory promised, beside what was measured."""

from __future__ import annotations

from collections.abc import Callable

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dnnmso_mj.figures.drawing import (
    COLOURS,
    DASHED,
    INK,
    arrange,
    decades,
    legend_above,
    line,
    log_line,
    name_panel,
    name_time_panel,
    panels,
    span_of,
    subscript,
)
from dnnmso_mj.metrics import worst_error
from dnnmso_mj.scenario import Madam
from dnnmso_mj.scenario.controller import inversion as inversion_of
from dnnmso_mj.trace import Array, Trace

Panel = Callable[[Axes, Trace], None]


def learning_figure(trace: Trace, title: str = "") -> Figure:
    """Learned against true dynamics, what is left between them, and how the weights move."""
    n = trace.n_joints
    draw: list[Panel] = [_learned_row(n + i) for i in range(n)]
    draw += [_learning_error, _observer_error, _weight_norms, _update_ratios]
    return _drawn(trace, draw, title)


def theory_figure(trace: Trace, title: str = "") -> Figure:
    """Each statement's bound beside the measured quantity; without a network only what exists."""
    draw: list[Panel] = [_theorem_1, _deep_relative_trust] if trace.n_layers else []
    draw += [_closed_loop_bound, _paper_bound, _lyapunov, _compute_time]
    return _drawn(trace, draw, title)


def _drawn(trace: Trace, draw: list[Panel], title: str) -> Figure:
    figure, axes = panels(len(draw), 2, title)
    for ax, panel in zip(axes, draw, strict=True):
        panel(ax, trace)
        legend_above(ax)
    arrange(figure, axes)
    return figure


def _learned_row(row: int) -> Panel:
    def draw(ax: Axes, trace: Trace) -> None:
        line(ax, trace["t"], trace["f_hat"][:, row], color=COLOURS[0], label="learned")
        line(ax, trace["t"], trace["f_true"][:, row], color=INK, label="true", **DASHED)
        joint = row - trace.n_joints + 1
        _name(ax, trace, f"Dynamics of joint {joint}", f"f{subscript(row + 1)} (rad/s²)")

    return draw


def _learning_error(ax: Axes, trace: Trace) -> None:
    log_line(ax, trace["t"], np.linalg.norm(_f_err(trace), axis=1), color=COLOURS[1])
    _name(ax, trace, "Learning error", "‖f̃‖ (rad/s, rad/s²)")


def _observer_error(ax: Axes, trace: Trace) -> None:
    log_line(ax, trace["t"], np.linalg.norm(trace["e_obs"], axis=1), color=COLOURS[1])
    _name(ax, trace, "Observer error", "‖X − X̂‖ (rad, rad/s)")


def _weight_norms(ax: Axes, trace: Trace) -> None:
    _layers(ax, trace["t"], trace["weight_norm"], line)
    _name(ax, trace, "Weights", "‖W‖ (–)")


def _update_ratios(ax: Axes, trace: Trace) -> None:
    _layers(ax, trace["t"], trace["update_ratio"], log_line)
    _name(ax, trace, "Updates", "‖ΔW‖ / ‖W‖ (–)")


def _theorem_1(ax: Axes, trace: Trace) -> None:
    _layers(ax, trace["t"], trace["eta_bound"], log_line)
    rule = getattr(trace.scenario.controller, "rule", None)
    if isinstance(rule, Madam):
        ax.axhline(rule.eta, color=INK, label="η used", **DASHED)
    _name(ax, trace, "Theorem 1", "bound on η (–)")


def _deep_relative_trust(ax: Axes, trace: Trace) -> None:
    """Only ticks at which the change was measured: between them it is held, its bound is not."""
    change = trace["gradient_change"]
    fresh = np.flatnonzero(np.any(np.diff(change, axis=0, prepend=0.0) != 0.0, axis=1))
    t = trace["t"][fresh]
    _layers(ax, t, change[fresh], log_line)
    log_line(ax, t, trace["drt_bound"][fresh], color=INK, label="bound")
    _name(ax, trace, "Deep relative trust", "gradient change (–)")


def _closed_loop_bound(ax: Axes, trace: Trace) -> None:
    t = trace["t"]
    log_line(ax, t, worst_error(trace), color=COLOURS[0], label="worst |e|")
    log_line(ax, t, trace["ultimate_bound"], color=COLOURS[1], label="bound", linewidth=1.1)
    static = _static_bound(trace)
    if static:
        ax.axhline(static, color=INK, label="ε/(Kλ)", **DASHED)
    _name(ax, trace, "Ultimate bound, this loop", "|e| (rad)")


def _paper_bound(ax: Axes, trace: Trace) -> None:
    t, bound = trace["t"], trace["ultimate_bound_paper"]
    log_line(ax, t, np.sqrt(trace["lyapunov"]), color=COLOURS[0], label="‖eᵣ‖")
    log_line(ax, t, bound, color=COLOURS[1], label="bound", linewidth=1.1)
    _name(ax, trace, "Ultimate bound, paper", "‖eᵣ‖ (rad, rad/s)")


def _lyapunov(ax: Axes, trace: Trace) -> None:
    log_line(ax, trace["t"], trace["lyapunov"], color=COLOURS[0])
    _name(ax, trace, "Lyapunov function", "‖eᵣ‖² (rad², rad²/s²)")


def _compute_time(ax: Axes, trace: Trace) -> None:
    taken = trace["compute_us"]
    counts, edges = np.histogram(np.log10(taken[taken > 0.0]), bins=80)
    ax.stairs(counts, 10.0**edges, baseline=0.1, fill=True, color=COLOURS[5])
    known = trace.info.metrics  # of all ticks, where only an outline is drawn
    marks = {
        "p50": (known.get("compute_us_p50") or np.percentile(taken, 50.0), "-"),
        "p99.9": (known.get("compute_us_p999") or np.percentile(taken, 99.9), ":"),
        "period": (trace.scenario.dt * 1e6, "--"),
    }
    for name, (value, style) in marks.items():
        text = np.format_float_positional(value, precision=3, fractional=False, trim="-")
        ax.axvline(value, color=INK, linestyle=style, linewidth=0.9, label=f"{name} {text}")
    ax.set_xscale("log")
    ax.set_yscale("log")
    name_panel(ax, "Compute time", "time of one update (µs)", "ticks (count)")
    ax.set_ylim(bottom=0.5)  # a single slow tick shows
    decades(ax.xaxis)


def _name(ax: Axes, trace: Trace, title: str, y: str) -> None:
    name_time_panel(ax, span_of([trace]), title, y)


def _layers(ax: Axes, t: Array, values: Array, draw: Callable[..., None]) -> None:
    """One line for each column of values (N, L), dark to light from input to output layer."""
    last = values.shape[1] - 1
    for layer, shade in enumerate(mpl.colormaps["viridis"](np.linspace(0.0, 0.85, last + 1))):
        label = f"W{subscript(layer + 1)}" if last < 6 or layer in (0, last) else ""
        draw(ax, t, values[:, layer], color=shade, label=label, linewidth=0.7)


def _f_err(trace: Trace) -> Array:
    """f̃ = (Ẋ - B τ) - f̂, shape (N, 2n)."""
    f_err: Array = trace["f_true"] - trace["f_hat"]
    return f_err


def _static_bound(trace: Trace) -> float | None:
    """ε/(K λ), ε the largest ‖f̃₂ + λ f̃₁‖ of the last half; None where the loop has no such form.

    It has none where K is not scalar, where B_s is general, and while the actuators saturate.
    """
    inversion, half = inversion_of(trace.scenario.controller), len(trace) // 2
    if inversion is None:
        return None
    K, lam = inversion.K, inversion.lam
    if inversion.slack_matrix is not None or len(set(K)) > 1 or lam == 0.0:
        return None
    if trace["saturated"][half:].any():
        return None
    f_err, n = _f_err(trace)[half:], trace.n_joints
    epsilon = np.linalg.norm(f_err[:, n:] + lam * f_err[:, :n], axis=1).max()
    return float(epsilon / (K[0] * lam))
