"""What a replay plots, tab by tab: decided by the scenario and the widths of its columns alone.

So it is the same for a run that is still going on. `dnnmso_mj.viewer.stream` writes the lines,
`dnnmso_mj.viewer.blueprint` lays out the plots, and neither knows what they mean.

The viewer's font has Latin, Greek, ² and ₁₀, but few combining accents; a headless viewer ends at a
character that it has not (ᵀ, for one).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from dnnmso_mj.scenario import (
    ClassicalMso,
    ConcurrentLearning,
    DnnMso,
    External,
    Imperfections,
    LewisNn,
    Madam,
    RbfMso,
    Scenario,
    SlotineLi,
    expand,
)
from dnnmso_mj.scenario.controller import inversion
from dnnmso_mj.scene import Scene
from dnnmso_mj.theory import UNDEFINED, build_bounds
from dnnmso_mj.trace import Array, StepLayout, Trace
from dnnmso_mj.viewer.plot import (
    BROAD,
    GREY,
    RED,
    THIN,
    WHITE,
    Level,
    Line,
    Plot,
    difference,
    distance,
    entry,
    joint_color,
    joints,
    layers,
    log10,
    log_plot,
    pale,
    scalar,
)

_HALVES = (("acceleration", "accelerations", "rad/s²"), ("velocity", "velocities", "rad/s"))


def plot_tabs(scenario: Scenario, scene: Scene, layout: StepLayout) -> dict[str, list[Plot]]:
    """Tab name -> its plots; Learning only for a controller that learns the dynamics.

    Args:
        scenario: the experiment.
        scene: the robot.
        layout: the widths of the run's columns.
    """
    learning = {"Learning": _learning(scenario, layout)} if learns(scenario, layout) else {}
    return {
        "Tracking": _tracking(scenario),
        **learning,
        "Theory": [*_network_theory(scenario, layout), *_loop_theory(scenario)],
        "Timing": _timing(scenario),
        "Scene": [_tip(scene)],
    }


def learns(scenario: Scenario, layout: StepLayout) -> bool:
    """Whether a controller's f̂ comes of what it has seen, as far as is known."""
    adaptive = RbfMso | LewisNn | SlotineLi | ConcurrentLearning | External
    return layout.n_layers > 0 or isinstance(scenario.controller, adaptive)


def _tracking(scenario: Scenario) -> list[Plot]:
    n = scenario.n_joints
    torque = joints("τ{}", n, partial(entry, "tau"))
    if _drives_err(scenario.imperfections):
        torque = (*pale(joints("commanded", n, partial(entry, "tau_cmd"))), *torque)
    limits = _torque_limits(scenario)
    most = 1.25 * max((level.value for level in limits), default=0.0)
    error, velocity_error = partial(difference, "q", "q_ref"), partial(difference, "qd", "qd_ref")
    return [
        Plot(
            "joint_angles",
            "Joint angles (rad)",
            _against_reference(scenario, "q"),
            legend="RightTop",
        ),
        Plot("velocities", "Joint velocities (rad/s)", _against_reference(scenario, "qd")),
        log_plot("error_log", "Tracking error |q − q_ref| (log₁₀ of rad)", _errors(n)),
        Plot("error", "Tracking error q − q_ref (rad)", joints("e{}", n, error)),
        Plot(
            "torque",
            "Torque (N·m)",
            torque,
            limits,
            y_range=(-most, most) if limits else None,  # what is commanded may be far beyond
            legend="RightBottom",
        ),
        Plot(
            "velocity_error",
            "Velocity error q̇ − q̇_ref (rad/s)",
            joints("ė{}", n, velocity_error),
        ),
    ]


def _learning(scenario: Scenario, layout: StepLayout) -> list[Plot]:
    n = scenario.n_joints
    halves = list(zip(_HALVES, (slice(n, 2 * n), slice(0, n)), strict=True))
    if not _learns_velocities(scenario):
        del halves[1]
    plots = [_dynamics(f"dynamics_{path}", what, unit, rows) for (path, what, unit), rows in halves]
    f_err = [
        Line(f"{what} ({unit})", log10(distance("f_true", "f_hat", rows)), color, place=place)
        for ((_, what, unit), rows), color, place in zip(
            halves, (WHITE, GREY), (0, 1), strict=False
        )
    ]
    title = "Knowledge error: distance of f true and learned (log₁₀)"
    plots.append(log_plot("knowledge", title, tuple(f_err), legend="RightTop"))
    if hasattr(scenario.controller, "observer"):
        angles = joints("angles", n, lambda j: log10(entry("e_obs", j)))
        velocities = joints("velocities", n, lambda j: log10(entry("e_obs", n + j)))
        title = "Observer error |x − x̂| (log₁₀ of rad, rad/s)"
        lines = (*pale(angles), *velocities)
        plots.append(log_plot("observer", title, lines, legend="RightTop"))
    if layout.n_layers:
        norms = layers(layout.n_layers, partial(entry, "weight_norm"))
        ratios = layers(layout.n_layers, lambda k: log10(entry("update_ratio", k)))
        plots.append(Plot("weight_norm", "Weight norm ‖W‖", norms, legend="RightTop"))
        plots.append(log_plot("update_ratio", "Update ratio ‖ΔW‖/‖W‖ (log₁₀)", ratios))
    return plots


def _learns_velocities(scenario: Scenario) -> bool:
    """Whether the upper rows of f, the velocities, are learned, and not taken as measured."""
    controller = scenario.controller
    outputs = getattr(getattr(controller, "network", None), "outputs", "kinematic")
    return outputs == "full" and not isinstance(controller, ClassicalMso)


def _dynamics(path: str, what: str, unit: str, rows: slice) -> Plot:
    """The true rows of f, and the learned ones over them."""
    n, first = rows.stop - rows.start, rows.start
    true = joints("true", n, lambda j: entry("f_true", first + j))
    learned = joints("learned", n, lambda j: entry("f_hat", first + j))
    title = f"Dynamics f, true and learned: {what} ({unit})"
    return Plot(path, title, (*pale(true), *learned), legend="RightTop")


def _network_theory(scenario: Scenario, layout: StepLayout) -> list[Plot]:
    if not layout.n_layers:
        return []
    controller = scenario.controller
    eta: tuple[Level, ...] = ()
    if isinstance(controller, DnnMso | ClassicalMso) and isinstance(controller.rule, Madam):
        eta = (Level("η in use", controller.madam.eta, WHITE),)
    trust = (
        Line("deep relative trust", log10(scalar("drt_bound")), WHITE, BROAD, role="context"),
        *layers(layout.n_layers, lambda k: log10(entry("gradient_change", k))),
    )
    return [
        Plot(
            "theorem_1",
            "Theorem 1: what η must be below",
            layers(layout.n_layers, partial(entry, "eta_bound")),
            eta,
            legend="RightTop",
        ),
        log_plot("relative_trust", "Relative change of the gradient (log₁₀)", trust, "RightTop"),
    ]


def _loop_theory(scenario: Scenario) -> list[Plot]:
    n = scenario.n_joints
    law = inversion(scenario.controller)
    bounds = build_bounds(law, n, scenario.dt, first_order=False)
    lines = [
        Line(name, log10(scalar(column)), color, role="context")
        for name, column, bound, color in (
            ("bound on |e|", "ultimate_bound", bounds.joint, WHITE),
            ("paper's, on ‖e_r‖", "ultimate_bound_paper", bounds.paper, GREY),
        )
        if bound[0] != UNDEFINED
    ]
    title = "Tracking error and its bounds (log₁₀ of rad)"
    lyapunov = Line("L", log10(scalar("lyapunov")), WHITE)
    return [
        log_plot("lyapunov", "Lyapunov function L = ‖e_r‖² (log₁₀)", (lyapunov,)),
        log_plot("bounds", title, (*lines, *_errors(n)), legend="RightTop"),
    ]


def _timing(scenario: Scenario) -> list[Plot]:
    deadline = 1e6 * scenario.dt
    flags = (("saturated", RED), ("clipped", joint_color(1)), ("deadline_missed", WHITE))
    return [
        Plot(
            "compute_time",
            "Time for one update of the controller (µs)",
            (Line("update", scalar("compute_us"), joint_color(0), THIN),),
            (Level("deadline", deadline, RED),),
            y_range=(0.0, 1.2 * deadline),  # the first update compiles, and would hide all others
            legend="RightTop",
        ),
        Plot(
            "wake_late",
            "How late a tick began by the wall clock; 0 without --real-time (µs)",
            (Line("late", scalar("wake_late_us"), joint_color(2), THIN),),
        ),
        Plot(
            "flags",
            "Flags (1 = yes)",
            tuple(Line(name.replace("_", " "), scalar(name), color) for name, color in flags),
            y_range=(-0.1, 1.1),
            legend="RightTop",
        ),
    ]


def _tip(scene: Scene) -> Plot:
    """What the arm's error makes at its tip."""

    def away(trace: Trace) -> Array:
        between = scene.tip(trace["q"]) - scene.tip(trace["q_ref"])  # (N, 3)
        return np.asarray(np.linalg.norm(between, axis=1))

    line = Line("tip", log10(away), joint_color(0))
    return log_plot("tip", "Distance of the tip from where it should be (log₁₀ of m)", (line,))


def _against_reference(scenario: Scenario, name: str) -> tuple[Line, ...]:
    """The reference, what was measured where that is not the true value, and the true value."""
    n, symbol = scenario.n_joints, {"q": "q", "qd": "q̇"}[name]
    desired = pale(joints("desired", n, partial(entry, f"{name}_ref")))
    lines = tuple(replace(line, role="shared") for line in desired)
    if _sensors_err(scenario.imperfections):
        measured = joints("measured", n, partial(entry, f"{name}_meas"))
        lines += tuple(replace(line, color=GREY, width=THIN, role="context") for line in measured)
    return lines + joints(symbol + "{}", n, partial(entry, name))


def _sensors_err(imperfections: Imperfections) -> bool:
    """Whether what is measured can be something else than what is."""
    ideal = Imperfections()
    names = ("noise", "bias", "drift")
    erring = [f"{what}_{name}" for what in ("position", "velocity") for name in names]
    return (
        any(any(getattr(imperfections, name)) for name in erring)
        or imperfections.sensor_delay > 0.0
        or imperfections.jitter > 0.0
        or imperfections.encoder_counts is not None
        or imperfections.velocity_from != ideal.velocity_from
        or bool(imperfections.external)
    )


def _drives_err(imperfections: Imperfections) -> bool:
    """Whether the torque that acts can be another than the one commanded."""
    names = ("torque_limit", "torque_rate", "actuator_lag", "actuator_delay", "external")
    return any(bool(getattr(imperfections, name)) for name in names)


def _errors(n: int) -> tuple[Line, ...]:
    return joints("|e{}|", n, lambda j: log10(difference("q", "q_ref", j)))


def _torque_limits(scenario: Scenario) -> tuple[Level, ...]:
    limit = scenario.imperfections.torque_limit
    if limit is None:
        return ()
    values = expand(limit, scenario.n_joints)
    colors = [joint_color(j) for j in range(len(values))]
    if np.all(values == values[0]):
        values, colors = values[:1], [RED]
    return tuple(
        Level("limit", sign * float(value), color)
        for value, color in zip(values, colors, strict=True)
        for sign in (1.0, -1.0)
    )
