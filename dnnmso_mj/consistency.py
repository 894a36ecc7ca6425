"""The rules that tie one part of a scenario to another: sizes to joints, times and gains to dt."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from dnnmso_mj.scenario.backstepping import Backstepping
from dnnmso_mj.scenario.controller import effectiveness, inversion
from dnnmso_mj.scenario.policy import Policy
from dnnmso_mj.scenario.replay import DnnMsoReplay
from dnnmso_mj.scenario.rivals import Rival

if TYPE_CHECKING:
    from pydantic import BaseModel

    from dnnmso_mj.scenario import Scenario

MAX_TICKS = 100_000_000
MULTIPLE = "multiple of dt = {0} within the duration; allowed: {0}, or several times that"
STEP_GAINS = ("K_q", "K_v", "K_tau")

Problem = tuple[str, str]


def contradictions(scenario: Scenario) -> list[Problem]:
    """Every key path that does not go with the others, and what is wrong with it."""
    return [
        *_step_count(scenario),
        *_times_below_dt(scenario),
        *_observer_gain(scenario),
        *_step_gains(scenario),
        *_policy_step(scenario),
        *_stalls(scenario),
        *_events(scenario),
        *_sizes(scenario),
    ]


def entries(count: int) -> str:
    """A length in words."""
    return "1 entry" if count == 1 else f"{count} entries"


def _step_count(scenario: Scenario) -> Iterator[Problem]:
    steps = scenario.duration / scenario.dt
    if not 0.5 < steps <= MAX_TICKS or abs(steps - round(steps)) > 1e-6:
        allowed = f"allowed: a whole number of steps from 1 to {MAX_TICKS}"
        yield "duration", f"is {steps:.10g} steps of dt = {scenario.dt}; {allowed}"


def _times_below_dt(scenario: Scenario) -> Iterator[Problem]:
    """Motions within less than a step: no controller sees them, and splines overflow on them."""
    ref, dt = scenario.reference, scenario.dt
    allowed = f"allowed: dt = {dt} or more"
    if ref.kind == "setpoint" and ref.blend_time < dt:
        yield "reference.blend_time", f"is less than one step; {allowed}"
    if ref.kind == "waypoints":
        for k, gap in enumerate(b - a for a, b in zip(ref.times, ref.times[1:], strict=False)):
            if gap < dt * (1 - 1e-9):
                text = f"comes {gap:.3g} s after the time before, less than one step; {allowed}"
                yield f"reference.times.{k + 1}", text


def _observer_gain(scenario: Scenario) -> Iterator[Problem]:
    most = 2.0 / scenario.dt
    for path, K2 in _observer_gains(scenario):
        if max(K2) >= most:
            yield path, f"makes a sampled observer unstable; allowed: K2 < 2/dt = {most:g}"


def _observer_gains(scenario: Scenario) -> Iterator[tuple[str, tuple[float, ...]]]:
    controller = scenario.controller
    if hasattr(controller, "observer"):
        yield "controller.observer.K2", controller.observer.K2
    elif isinstance(controller, DnnMsoReplay):
        yield "controller.K2", controller.K2


def _step_gains(scenario: Scenario) -> Iterator[Problem]:
    controller, most = scenario.controller, 2.0 / scenario.dt
    if controller.kind != "backstepping":
        return
    for name in STEP_GAINS:
        if max(getattr(controller, name)) >= most:
            problem = f"makes a sampled error unstable; allowed: {name} < 2/dt = {most:g}"
            yield f"controller.{name}", problem


def _policy_step(scenario: Scenario) -> Iterator[Problem]:
    held = getattr(scenario.controller, "control_timestep", None)
    if held is not None and not is_multiple(held, scenario):
        yield "controller.control_timestep", f"is no {MULTIPLE.format(scenario.dt)}"


def is_multiple(time: float, scenario: Scenario) -> bool:
    """Whether a time is a whole number of steps within the scenario."""
    steps = time / scenario.dt
    return 0.5 < steps < scenario.n_ticks + 0.5 and abs(steps - round(steps)) <= 1e-6


def _stalls(scenario: Scenario) -> Iterator[Problem]:
    for k, stall in enumerate(scenario.real_time.stalls):
        if stall.at > scenario.duration - 0.5 * scenario.dt:
            yield (
                f"real_time.stalls.{k}.at",
                f"is at the end or after it; allowed: below {scenario.duration:g} s",
            )


def _events(scenario: Scenario) -> Iterator[Problem]:
    for k, event in enumerate(scenario.events):
        if event.at > scenario.duration - 0.5 * scenario.dt:
            yield (
                f"events.{k}.at",
                f"is at the end or after it; allowed: below {scenario.duration:g} s",
            )
        if event.kind == "push" and event.duration < scenario.dt * (1 - 1e-9):
            allowed = f"allowed: dt = {scenario.dt} or more"
            yield f"events.{k}.duration", f"is less than one step; {allowed}"


def _sizes(scenario: Scenario) -> Iterator[Problem]:
    n = scenario.n_joints
    for path, found, allowed in _vectors(scenario, n):
        if found not in allowed:
            choices = " or ".join(map(str, sorted(allowed)))
            reason = f"since initial.q has {entries(n)}"
            yield path, f"has {entries(found)}; allowed: {choices}, {reason}"


def _vectors(scenario: Scenario, n: int) -> Iterator[tuple[str, int, set[int]]]:
    """Every vector: its key path, its length and the lengths allowed."""
    yield "initial.qd", len(scenario.initial.qd), {1, n}
    if scenario.plant.masses:
        yield "plant.masses", len(scenario.plant.masses), {n}
    yield from _reference_vectors(scenario, n)
    yield from _controller_vectors(scenario, n)
    yield from _numbers("imperfections", scenario.imperfections, n)
    yield from _numbers("imperfections.friction", scenario.imperfections.friction, n)
    yield from _numbers("safety", scenario.safety, n)
    for k, event in enumerate(scenario.events):
        if event.kind == "push" and event.torque:
            yield f"events.{k}.torque", len(event.torque), {1, n}


def _numbers(path: str, part: BaseModel, n: int) -> Iterator[tuple[str, int, set[int]]]:
    """Every list of a part: one number for all joints, or one for each."""
    for name, values in part:
        if isinstance(values, tuple) and values and isinstance(values[0], int | float):
            yield f"{path}.{name}", len(values), {1, n}


def _controller_vectors(scenario: Scenario, n: int) -> Iterator[tuple[str, int, set[int]]]:
    controller, path = scenario.controller, "controller"
    law = inversion(controller)
    if law is not None:
        path = "controller.inversion"
        yield f"{path}.K", len(law.K), {1, 2 * n}
        if law.slack_matrix:
            yield f"{path}.slack_matrix", len(law.slack_matrix), {2 * n}
    believed = effectiveness(controller)
    if believed.kind == "inertia":
        for name in ("masses", "lengths"):
            values = getattr(believed, name)
            if values:
                yield f"{path}.effectiveness.{name}", len(values), {n}
    for path, K2 in _observer_gains(scenario):
        yield path, len(K2), {1, 2 * n}
    if isinstance(controller, Rival | Backstepping | Policy):  # their lists are of joints
        yield from _numbers("controller", controller, n)
    for name, allowed in (("K_v", {1, n}), ("box", {1, 2 * n})):
        if hasattr(controller, name):
            yield f"controller.{name}", len(getattr(controller, name)), allowed


def _reference_vectors(scenario: Scenario, n: int) -> Iterator[tuple[str, int, set[int]]]:
    ref = scenario.reference
    if ref.kind == "setpoint":
        yield "reference.start", len(ref.start), {n}
        yield "reference.goal", len(ref.goal), {n}
    elif ref.kind == "waypoints":
        for k, point in enumerate(ref.points):
            yield f"reference.points.{k}", len(point), {n}
    else:
        for name in ("amplitude", "frequency", "phase", "offset"):
            if hasattr(ref, name):
                yield f"reference.{name}", len(getattr(ref, name)), {1, n}
