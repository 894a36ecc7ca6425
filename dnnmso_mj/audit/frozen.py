"""Scenarios with frozen weights, made from the one that is audited.

The plant stays what it is at the freeze: payloads set in before it stay, later events are left out.
"""

from __future__ import annotations

import json
from typing import Any, Literal

import numpy as np

from dnnmso_mj.audit.unseen import SPAN, Unseen, reference_states
from dnnmso_mj.scenario import Scenario

What = Literal["model", "all"]

SHORTEST, LONGEST = 10.0, 20.0  # s


def window(scenario: Scenario) -> float:
    """How long the arm goes on along the same trajectory (s), a whole number of steps.

    The longest period of a sinusoid, if that is 10 to 20 s; else the nearest of these; 10 s on any
    other reference.
    """
    reference, length = scenario.reference, SHORTEST
    if reference.kind == "sinusoid":
        slowest = min((abs(w) for w in reference.frequency if w != 0.0), default=np.inf)
        length = float(np.clip(2.0 * np.pi / slowest, SHORTEST, LONGEST))
    return steps(scenario, length)


def steps(scenario: Scenario, time: float) -> float:
    """The nearest whole number of steps (s)."""
    return round(time / scenario.dt) * scenario.dt


def same_trajectory(scenario: Scenario, at: float, what: What) -> Scenario:
    """Learning until `at` (s), then frozen for a `window`."""
    events = [*_plant_events(scenario, at), _freeze(at, what)]
    duration = steps(scenario, at + window(scenario))
    return _edited(scenario, duration=duration, events=events)


def other_trajectory(scenario: Scenario, at: float, unseen: Unseen) -> Scenario:
    """Frozen from the start, on the plant as it is at `at` (s), beginning on the reference."""
    x = reference_states(unseen.reference, scenario.n_joints, np.zeros(1))[0]
    kept = [event for event in _plant_events(scenario, at) if event["kind"] == "payload"]
    return _edited(
        scenario,
        duration=steps(scenario, SPAN),
        reference=unseen.reference.model_dump(mode="json"),
        initial={"q": x[: scenario.n_joints].tolist(), "qd": x[scenario.n_joints :].tolist()},
        events=[*({**event, "at": 0.0} for event in kept), _freeze(0.0, "all")],
    )


def without_model(scenario: Scenario) -> Scenario:
    """The same law with f̂ = [q̇; 0]: `no_network` with the controller's inversion and observer.

    A controller that has no inversion of its own is held against `no_network`'s defaults, with the
    effectiveness that it believes in.
    """
    controller = scenario.controller.model_dump(mode="json")
    law: dict[str, Any] = {"kind": "no_network"}
    law |= {key: controller[key] for key in ("inversion", "observer") if key in controller}
    if "inversion" not in law and "effectiveness" in controller:
        law["inversion"] = {"effectiveness": controller["effectiveness"]}
    return _edited(scenario, controller=law)


def _plant_events(scenario: Scenario, at: float) -> list[dict[str, Any]]:
    events = (event.model_dump(mode="json") for event in scenario.events)
    return [event for event in events if event["kind"] != "freeze" and event["at"] <= at]


def _freeze(at: float, what: What) -> dict[str, Any]:
    return {"kind": "freeze", "at": at, "what": what}


def _edited(scenario: Scenario, **parts: Any) -> Scenario:
    """The scenario with some parts replaced, validated anew."""
    return Scenario.model_validate_json(json.dumps(scenario.model_dump(mode="json") | parts))
