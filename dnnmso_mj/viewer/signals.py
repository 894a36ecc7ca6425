"""What a replay plots: the columns of a trace as titled plots of named, coloured lines.

What the viewer shows beside the arm is decided here, once: `dnnmso_mj.viewer.rrd` writes the lines,
`dnnmso_mj.viewer.blueprint` lays out the plots, and neither knows what they mean.

The viewer's font has Latin, Greek, ² and ₁₀, but few combining accents; a headless viewer ends at a
character that it has not (ᵀ, for one).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dnnmso_mj.scenario import ClassicalMso, DnnMso, Madam, expand
from dnnmso_mj.trace import Array, Trace

Rgb = tuple[int, int, int]
Corner = Literal["LeftTop", "LeftBottom", "RightTop", "RightBottom"]

TIMELINE = "time"  # what every line, pose and event is placed on: simulated time
JOINT_COLORS: tuple[Rgb, ...] = (
    (66, 150, 250),
    (255, 150, 50),
    (80, 200, 130),
    (240, 90, 110),
    (180, 140, 245),
    (230, 200, 80),
    (80, 200, 210),
)
WHITE: Rgb = (235, 235, 235)
GREY: Rgb = (150, 150, 150)
RED: Rgb = (235, 70, 70)
_FIRST_LAYER, _LAST_LAYER = np.array([240, 110, 210]), np.array([250, 230, 90])
THIN, NORMAL, BROAD = 1.0, 1.5, 4.0  # points; a broad line is seen on both sides of one over it


@dataclass(frozen=True)
class Line:
    """One value a tick, shape (N,); a NaN leaves a gap."""

    name: str
    values: Array
    color: Rgb
    width: float = NORMAL


@dataclass(frozen=True)
class Level:
    """A value that holds for the whole run, such as a limit."""

    name: str
    value: float
    color: Rgb


@dataclass(frozen=True)
class Plot:
    """Lines drawn over one another, the first at the bottom; `path` is unique among all plots."""

    path: str
    title: str
    lines: tuple[Line, ...]
    levels: tuple[Level, ...] = ()
    y_range: tuple[float, float] | None = None  # None: whatever the lines need
    # What a pixel shows of the many ticks that fall on it. Of a logarithm the low peaks are mere
    # zero crossings. Never the mean: it would hide the peaks of torque and of compute time.
    pixel: Literal["extremes", "largest"] = "extremes"
    legend: Corner = "RightTop"  # where the lines seldom are


def joint_color(joint: int) -> Rgb:
    """The colour of a joint (from 0), the same in every plot and on the arm."""
    return JOINT_COLORS[joint % len(JOINT_COLORS)]


def plot_tabs(trace: Trace) -> dict[str, list[Plot]]:
    """Tab name -> its plots; those of a network only for a run that has one.

    Args:
        trace: a run of at least one tick.
    """
    network = {"Learning": _learning(trace)} if trace.n_layers else {}
    return {
        "Tracking": _tracking(trace),
        "Motion": _motion(trace),
        **network,
        "Theory": [*(_network_theory(trace) if network else []), *_loop_theory(trace)],
        "Timing": _timing(trace),
    }


def _tracking(trace: Trace) -> list[Plot]:
    error = _joints("|e{}|", _log10(trace["q"] - trace["q_ref"]))
    torque = _joints("τ{}", trace["tau"])
    if not np.array_equal(trace["tau_cmd"], trace["tau"]):
        torque = (*_pale("τ{} commanded", trace["tau_cmd"]), *torque)
    return [
        Plot("joint_angles", "Joint angles (rad)", _against_reference(trace, "q")),
        _log_plot("error_log", "Tracking error |q − q_ref| (log₁₀ of rad)", error),
        Plot("torque", "Torque (N·m)", torque, _torque_limits(trace), legend="RightBottom"),
    ]


def _motion(trace: Trace) -> list[Plot]:
    angle = _joints("e{}", trace["q"] - trace["q_ref"])
    velocity = _joints("ė{}", trace["qd"] - trace["qd_ref"])
    return [
        Plot("velocities", "Joint velocities (rad/s)", _against_reference(trace, "qd")),
        Plot("error", "Tracking error q − q_ref (rad)", angle),
        Plot("velocity_error", "Velocity error q̇ − q̇_ref (rad/s)", velocity),
    ]


def _learning(trace: Trace) -> list[Plot]:
    n, e_obs = trace.n_joints, trace["e_obs"]
    ratio = _layers(_log10(trace["update_ratio"]))
    return [
        *(_learned_row(trace, row) for row in range(2 * n)),
        Plot("observer_angle", "Observer error, angles (rad)", _joints("q{}", e_obs[:, :n])),
        Plot(
            "observer_velocity", "Observer error, velocities (rad/s)", _joints("q̇{}", e_obs[:, n:])
        ),
        Plot("weight_norm", "Weight norm ‖W‖", _layers(trace["weight_norm"])),
        _log_plot("update_ratio", "Update ratio ‖ΔW‖/‖W‖ (log₁₀)", ratio),
    ]


def _learned_row(trace: Trace, row: int) -> Plot:
    n = trace.n_joints
    color, unit = joint_color(row % n), "rad/s" if row < n else "rad/s²"
    lines = (
        Line("f true", trace["f_true"][:, row], _lighter(color), BROAD),
        Line("f learned", trace["f_hat"][:, row], color),
    )
    return Plot(f"dynamics_{row + 1}", f"Dynamics f, row {row + 1} of {2 * n} ({unit})", lines)


def _network_theory(trace: Trace) -> list[Plot]:
    controller = trace.scenario.controller
    eta: tuple[Level, ...] = ()
    if isinstance(controller, DnnMso | ClassicalMso) and isinstance(controller.rule, Madam):
        eta = (Level("η in use", controller.madam.eta, WHITE),)
    trust = (
        Line("deep relative trust", _log10(trace["drt_bound"]), WHITE, BROAD),
        *_layers(_log10(trace["gradient_change"])),
    )
    return [
        Plot(
            "theorem_1",
            "Theorem 1: what η must be below",
            _layers(trace["eta_bound"]),
            eta,
            legend="RightBottom",
        ),
        _log_plot("relative_trust", "Relative change of the gradient (log₁₀)", trust),
    ]


def _loop_theory(trace: Trace) -> list[Plot]:
    lyapunov = Line("L", _log10(trace["lyapunov"]), WHITE)
    bounds = [
        Line(name, _log10(trace[column]), color)
        for name, column, color in (
            ("bound on |e|", "ultimate_bound", WHITE),
            ("paper's, on ‖e_r‖", "ultimate_bound_paper", GREY),
        )
        if (trace[column] >= 0.0).all()  # negative where the gains in use have no such bound
    ]
    error = _joints("|e{}|", _log10(trace["q"] - trace["q_ref"]))
    return [
        _log_plot("lyapunov", "Lyapunov function L = ‖e_r‖² (log₁₀)", (lyapunov,)),
        _log_plot(
            "bounds",
            "Tracking error and its bounds (log₁₀ of rad)",
            (*bounds, *error),
        ),
    ]


def _timing(trace: Trace) -> list[Plot]:
    deadline = 1e6 * trace.scenario.dt
    flags = (("saturated", RED), ("clipped", joint_color(1)), ("deadline_missed", WHITE))
    return [
        Plot(
            "compute_time",
            "Time for one update of the controller (µs)",
            (Line("update", trace["compute_us"], joint_color(0), THIN),),
            (Level("deadline", deadline, RED),),
            y_range=(0.0, 1.2 * deadline),  # the first update compiles, and would hide all others
        ),
        Plot(
            "flags",
            "Flags (1 = yes)",
            tuple(Line(n.replace("_", " "), trace[n].astype(float), c) for n, c in flags),
            y_range=(-0.1, 1.1),
        ),
    ]


def _log_plot(path: str, title: str, lines: tuple[Line, ...]) -> Plot:
    return Plot(path, title, lines, pixel="largest")


def _against_reference(trace: Trace, name: str) -> tuple[Line, ...]:
    """The reference, what was measured where that is not the true value, and the true value."""
    symbol, actual = {"q": "q", "qd": "q̇"}[name], trace[name]
    lines = _pale(symbol + "{} ref", trace[f"{name}_ref"])
    if not np.array_equal(trace[f"{name}_meas"], actual):
        measured = trace[f"{name}_meas"]
        lines += tuple(
            Line(f"{symbol}{j + 1} measured", column, GREY, THIN)
            for j, column in enumerate(measured.T)
        )
    return lines + _joints(symbol + "{}", actual)


def _joints(label: str, values: Array) -> tuple[Line, ...]:
    """A line for each column, in the joints' colours; `label` with {} for the joint's number."""
    return tuple(
        Line(label.format(j + 1), column, joint_color(j)) for j, column in enumerate(values.T)
    )


def _pale(label: str, values: Array) -> tuple[Line, ...]:
    """Broad lines in lighter colours, to lie under those of `_joints`."""
    return tuple(
        Line(line.name, line.values, _lighter(line.color), BROAD) for line in _joints(label, values)
    )


def _layers(values: Array) -> tuple[Line, ...]:
    count = values.shape[1]
    mix = np.linspace(0.0, 1.0, count)[:, None]
    colors = ((1.0 - mix) * _FIRST_LAYER + mix * _LAST_LAYER).astype(int).tolist()
    return tuple(
        Line(f"layer {k + 1}", column, tuple(color))
        for k, (column, color) in enumerate(zip(values.T, colors, strict=True))
    )


def _torque_limits(trace: Trace) -> tuple[Level, ...]:
    limit = trace.scenario.imperfections.torque_limit
    if limit is None:
        return ()
    values = expand(limit, trace.n_joints)
    if np.all(values == values[0]):
        return _both_signs("limit", values[:1], [RED])
    return _both_signs("limit {}", values, map(joint_color, range(len(values))))


def _both_signs(label: str, values: Array, colors: Iterable[Rgb]) -> tuple[Level, ...]:
    return tuple(
        Level(sign + label.format(j + 1), factor * float(value), color)
        for j, (value, color) in enumerate(zip(values, colors, strict=True))
        for sign, factor in (("+", 1.0), ("−", -1.0))
    )


def _lighter(color: Rgb) -> Rgb:
    red, green, blue = (round(0.4 * c + 0.6 * 255) for c in color)
    return red, green, blue


def _log10(values: Array) -> Array:
    """log₁₀ of the magnitude; zero, which has none, becomes a gap."""
    magnitude = np.abs(values)
    logarithm: Array = np.full(magnitude.shape, np.nan)
    np.log10(magnitude, out=logarithm, where=magnitude > 0.0)
    return logarithm
