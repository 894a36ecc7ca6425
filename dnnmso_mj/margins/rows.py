"""The rows of a margin card: each an imperfection, and how a scenario is given more of it.

A row is searched over a level, which is 0 for the scenario as it is and grows with what is asked of
the controller; `value` says what a level is in the row's own unit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.loading.complaints import explain
from dnnmso_mj.scenario import External, Inertia, Scenario
from dnnmso_mj.scenario.adaptive import ConcurrentLearning, SlotineLi
from dnnmso_mj.wording import clean, did_you_mean

Document = dict[str, Any]

POSITION_NOISE = 1e-4  # rad, times the factor of the row `noise`
VELOCITY_NOISE = 1e-3  # rad/s, likewise
VISCOUS_RATIO = 0.5  # N·m·s/rad of viscous friction for each N·m of Coulomb friction
PAYLOAD_AT = 0.0  # s


class MarginError(DnnmsoError):
    """Margins that cannot be asked for, searched or written."""


def _always_used(_scenario: Scenario) -> str:
    return ""


@dataclass(frozen=True)
class MarginRow:
    """One imperfection.

    Args:
        what: for people.
        unit: of `value`; "" for a factor.
        start: the first level that is probed.
        cap: the largest one.
        value: level -> the imperfection in its unit.
        change: puts a value into a scenario's document.
        smaller: whether the smaller value is the better one.
        unused: why the row would change nothing for a scenario's controller; "" where it would.
    """

    what: str
    unit: str
    start: float
    cap: float
    value: Callable[[float], float]
    change: Callable[[Document, Scenario, float], None]
    smaller: bool = False
    unused: Callable[[Scenario], str] = _always_used

    @property
    def at_cap(self) -> float:
        """The value at which the search ends."""
        return self.value(self.cap)

    def changed(self, scenario: Scenario, level: float) -> Scenario:
        """The scenario with this much of the imperfection; at level 0, as it is.

        Raises:
            MarginError: no such scenario can be.
        """
        if level == 0.0:
            return scenario
        document = scenario.model_dump()
        self.change(document, scenario, self.value(level))
        try:
            return Scenario.model_validate(document)
        except ValidationError as error:
            problems = "; ".join(complaint.text for complaint in explain(error, document))
            raise MarginError(f"{self.what}: {problems}") from error


def _actuator_delay(document: Document, _scenario: Scenario, value: float) -> None:
    document["imperfections"]["actuator_delay"] = value


def _payload(document: Document, _scenario: Scenario, value: float) -> None:
    event = {"kind": "payload", "at": PAYLOAD_AT, "mass": value}
    document["events"] = (*document.get("events", ()), event)


def _friction(document: Document, _scenario: Scenario, value: float) -> None:
    before = document["imperfections"].get("friction", {})
    dry = {"coulomb": (value,), "breakaway": None}  # at rest as much as in motion
    viscous = {"viscous": (VISCOUS_RATIO * value,)}
    document["imperfections"]["friction"] = before | dry | viscous


def _noise(document: Document, _scenario: Scenario, value: float) -> None:
    imperfections = document["imperfections"]
    imperfections["position_noise"] = (POSITION_NOISE * value,)
    if imperfections.get("velocity_from") != "difference":  # of angles, whose noise it has then
        imperfections["velocity_noise"] = (VELOCITY_NOISE * value,)


def _torque_limit(document: Document, _scenario: Scenario, value: float) -> None:
    document["imperfections"]["torque_limit"] = (value,)


def _no_masses(scenario: Scenario) -> str:
    if nominal_model(scenario.controller) is None:
        return "uses none"
    return "" if _masses(scenario) else "uses the masses of the model's file"


def _masses(scenario: Scenario) -> tuple[float, ...]:
    """What the controller believes (kg); empty where only the model's file says it."""
    part: Any = scenario.controller
    for key in nominal_model(scenario.controller) or ():
        part = getattr(part, key)
    return part.masses or scenario.plant.masses or ()


def _nominal_masses(document: Document, scenario: Scenario, value: float) -> None:
    part = document["controller"]
    for key in nominal_model(scenario.controller) or ():
        part = part[key]
    part["masses"] = tuple(value * mass for mass in _masses(scenario))


def _same(level: float) -> float:
    return level


def _above(level: float) -> float:
    return 1.0 + level


def _below(level: float) -> float:
    return 1.0 / (1.0 + level)


def _inverse(level: float) -> float:
    return 1.0 / level


ROWS: Mapping[str, MarginRow] = {
    "delay": MarginRow(
        what="actuator delay",
        unit="s",
        start=5e-4,
        cap=0.512,
        value=_same,
        change=_actuator_delay,
    ),
    "payload": MarginRow(
        what=f"payload at the tip from {PAYLOAD_AT:g} s on",
        unit="kg",
        start=0.1,
        cap=51.2,
        value=_same,
        change=_payload,
    ),
    "friction": MarginRow(
        what=f"Coulomb friction of each joint, and {VISCOUS_RATIO:g} N·m·s/rad of viscous a N·m",
        unit="N·m",
        start=0.1,
        cap=102.4,
        value=_same,
        change=_friction,
    ),
    "noise": MarginRow(
        what=f"factor of a noise of {POSITION_NOISE:g} rad and {VELOCITY_NOISE:g} rad/s",
        unit="",
        start=0.125,
        cap=1000.0,
        value=_same,
        change=_noise,
    ),
    "model_above": MarginRow(
        what="factor of the nominal masses, above 1",
        unit="",
        start=0.05,
        cap=12.8,
        value=_above,
        change=_nominal_masses,
        unused=_no_masses,
    ),
    "model_below": MarginRow(
        what="factor of the nominal masses, below 1",
        unit="",
        start=0.05,
        cap=12.8,
        value=_below,
        change=_nominal_masses,
        smaller=True,
        unused=_no_masses,
    ),
    "torque_limit": MarginRow(
        what="smallest torque limit of each joint",
        unit="N·m",
        start=1 / 400.0,
        cap=1.0,
        value=_inverse,
        change=_torque_limit,
        smaller=True,
    ),
}
GROUPS: Mapping[str, tuple[str, ...]] = {"model": ("model_above", "model_below")}


def parse_rows(text: str | None) -> tuple[str, ...]:
    """Names of rows, in the card's order; None: all.

    Raises:
        MarginError: no such row.
    """
    if text is None:
        return tuple(ROWS)
    words = [word.strip() for word in text.split(",")]
    unknown = [word for word in words if word not in ROWS and word not in GROUPS]
    if unknown:
        known = [*ROWS, *GROUPS]
        hint = did_you_mean(unknown[0], known)
        raise MarginError(
            f"--rows {clean(text)}: {clean(unknown[0]) or 'nothing'}: no such row; "
            f"allowed: {', '.join(known)}{hint}"
        )
    wanted = {name for word in words for name in GROUPS.get(word, (word,))}
    return tuple(name for name in ROWS if name in wanted)


def nominal_model(controller: Any) -> tuple[str, ...] | None:
    """Where a controller's settings hold its nominal masses, below `controller`; None: nowhere."""
    for path in (("inversion", "effectiveness"), ("effectiveness",)):
        part = controller
        for key in path:
            part = getattr(part, key, None)
        if isinstance(part, Inertia):
            return path
    return None


def is_model_free(controller: Any) -> bool:
    """Whether a controller's settings give it no model: neither masses, a regressor, nor code."""
    may_know = isinstance(controller, SlotineLi | ConcurrentLearning | External)
    return nominal_model(controller) is None and not may_know
