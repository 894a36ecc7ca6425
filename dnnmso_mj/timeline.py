"""The events of a scenario, as what to do at which tick."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

from dnnmso_mj.controllers import MODEL_ALONE, MODEL_FROZEN
from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.imperfections.loads import Loads
from dnnmso_mj.imperfections.tip import Tip
from dnnmso_mj.scenario import Freeze, Payload, Push, Scenario, expand

Array = np.ndarray


class Happening(NamedTuple):
    """One change of the world, between two ticks."""

    tick: int
    message: str
    act: Callable[[], None]


def tip_of_interest(scenario: Scenario) -> bool:
    """Whether anything happens at the tip of the last link."""
    return any(
        isinstance(event, Payload) or (isinstance(event, Push) and event.force is not None)
        for event in scenario.events
    )


def plan(scenario: Scenario, loads: Loads, tip: Tip | None, frozen: Array) -> list[Happening]:
    """Everything that happens in a run, in order.

    Args:
        scenario: the experiment.
        loads: what pushes change.
        tip: of the plant, where payloads are; None if nothing happens there.
        frozen: `Inputs.frozen`, which freezing changes.

    Raises:
        ScenarioError: a payload leaves too little of the link.
    """
    happenings = [*_freezes(scenario, frozen), *_pushes(scenario, loads)]
    if tip is not None:
        happenings += _payloads(scenario, tip)
    return sorted(happenings, key=lambda happening: happening.tick)


def _freezes(scenario: Scenario, frozen: Array) -> Iterator[Happening]:
    for event in scenario.events:
        if isinstance(event, Freeze):
            left = "" if event.what == "model" else ", and no disturbance is estimated"
            value = MODEL_FROZEN if event.what == "model" else MODEL_ALONE
            tick = round(event.at / scenario.dt)
            yield Happening(tick, f"learning ends{left}", partial(_set, frozen, value))


def _payloads(scenario: Scenario, tip: Tip) -> Iterator[Happening]:
    """Each with all that hangs at the tip from then on, so that nothing is rounded twice."""
    total = 0.0
    numbered = [(k, e) for k, e in enumerate(scenario.events) if isinstance(e, Payload)]
    for k, event in sorted(numbered, key=lambda item: item[1].at):
        total += event.mass
        try:
            mass = tip.loaded(total)["mass"][0]
        except ScenarioError as error:
            raise ScenarioError(f"events.{k}.mass = {event.mass:g}: {error}") from error
        what = "taken up" if event.mass > 0 else "dropped"
        message = f"{abs(event.mass):g} kg {what} at the tip: {tip.name()} has {mass:g} kg"
        tick = round(event.at / scenario.dt)
        yield Happening(tick, message, partial(tip.carry, total))


def _pushes(scenario: Scenario, loads: Loads) -> Iterator[Happening]:
    """At each begin and end, the sum of what pushes from then on."""
    n, dt = scenario.n_joints, scenario.dt
    spans = []
    for event in scenario.events:
        if isinstance(event, Push):
            first = round(event.at / dt)
            last = first + round(event.duration / dt)
            torque = expand(event.torque, n) if event.torque else np.zeros(n)
            force = event.force or (0.0, 0.0)
            f = np.array([force[0], 0.0 if len(force) == 2 else force[1], force[-1]])
            spans.append((first, last, np.concatenate([torque, f])))
    for first, last, wrench in spans:
        for tick, what in ((first, "begins"), (last, "ends")):
            acting = [each for begin, end, each in spans if begin <= tick < end]
            total = np.sum(acting, axis=0) if acting else np.zeros(n + 3)
            message = f"a push {what}: {_in_words(wrench, n)}"
            yield Happening(tick, message, partial(_push, loads, total))


def _in_words(wrench: Array, n: int) -> str:
    parts = []
    if wrench[:n].any():
        parts.append(f"{_listed(wrench[:n])} N·m on the joints")
    if wrench[n:].any():
        parts.append(f"{_listed(wrench[n:])} N at the tip")
    return ", ".join(parts)


def _listed(values: Array) -> str:
    return "[" + ", ".join(f"{value:g}" for value in values) + "]"


def _push(loads: Loads, wrench: Array) -> None:
    loads.push[:] = wrench


def _set(array: Array, value: int) -> None:
    array[0] = value
