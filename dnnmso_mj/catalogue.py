"""What ships, for people who choose: controllers with their sources, scenarios in short."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, get_args

from dnnmso_mj.loading import load_scenario
from dnnmso_mj.loading.tuned import read_tuned
from dnnmso_mj.paths import find_controller, scenario_names, scenarios_dir, shipped_controllers
from dnnmso_mj.scenario import Controller, Imperfections, Scenario

_MODEL = "masses and lengths, for M, V and G"
_INPUT = "what a torque does: masses and lengths, or one number"
_FORM = "that it is an arm of two links, and not its numbers"
_NOTHING = "nothing"

# Of each kind: its source, and what it must be told of the robot.
_KINDS = {
    "dnn_mso": ("the paper, Eq. 5 and 10, Alg. 1", _INPUT),
    "dnn_mso_replay": ("ours: docs/dnn_mso_replay.md", f"{_INPUT}; delays, if any"),
    "backstepping": (
        "ours: docs/backstepping.md, with Farrell et al. 2009",
        f"{_INPUT}; the drives' lag, if any",
    ),
    "no_network": ("the paper", _INPUT),
    "classical_mso": ("the paper, Eq. 4", _MODEL),
    "rbf_mso": ("Padhi et al. 2007; Sanner, Slotine 1992", _MODEL),
    "lewis_nn": ("Lewis, Yesildirek, Liu 1996", _NOTHING),
    "slotine_li": ("Slotine, Li 1987", _FORM),
    "concurrent_learning": ("Chowdhary, Johnson 2010; Parikh et al. 2019", _FORM),
    "pd": ("Takegaki, Arimoto 1981", _NOTHING),
    "pid": ("Åström, Hägglund 1995", _NOTHING),
    "computed_torque": ("Luh, Walker, Paul 1980", _MODEL),
    "adrc": ("Gao 2003", _INPUT),
    "sliding_mode": ("Slotine, Li 1991", _INPUT),
    "rise": ("Xian et al. 2004", _NOTHING),
    "l1": ("Hovakimyan, Cao 2010", _INPUT),
    "external": ("your own: docs/extending.md", "what its code asks for"),
    "policy": ("your own: docs/environments.md", "what it was trained with"),
}


@dataclass(frozen=True)
class Kind:
    """A kind of controller: what it is, where it is from, what it must be told of the robot."""

    kind: str
    what: str
    source: str
    told: str


@dataclass(frozen=True)
class Tuned:
    """A shipped tuned controller, and how it was found; nothing of that if by hand."""

    name: str
    kind: str
    scenario: str | None = None
    trials: int | None = None
    value: float | None = None
    date: str | None = None


@dataclass(frozen=True)
class Shipped:
    """A shipped scenario in short."""

    name: str
    description: str
    controller: str
    reference: str
    duration: float  # s
    imperfections: tuple[str, ...]  # keys that are not off
    events: tuple[str, ...]  # kinds, in their order


def kinds() -> list[Kind]:
    """Every kind of controller, in the order of the scenario's schema."""
    found = []
    for model in get_args(get_args(Controller)[0]):
        (kind,) = get_args(model.model_fields["kind"].annotation)
        what = (model.__doc__ or "").split("\n")[0].rstrip(".")
        found.append(Kind(kind, what, *_KINDS[kind]))
    return found


def tuned_controllers() -> list[Tuned]:
    """Every shipped tuned controller, by name."""
    return [_tuned(name) for name in shipped_controllers()]


def shipped_scenarios() -> list[Shipped]:
    """Every shipped scenario, our own first, by name."""
    folder = scenarios_dir()
    return [_shipped(name, load_scenario(folder / f"{name}.yaml")) for name in scenario_names()]


def _tuned(name: str) -> Tuned:
    data: dict[str, Any] = read_tuned(find_controller(name, scenarios_dir())).plain()
    found, kind = data.get("tuning"), data["controller"]["kind"]
    if not found:
        return Tuned(name, kind)
    return Tuned(name, kind, found["scenario"], found["budget"], found["value"], found["date"])


def _shipped(name: str, scenario: Scenario) -> Shipped:
    parts, off = scenario.imperfections, Imperfections()
    return Shipped(
        name=name,
        description=scenario.description,
        controller=scenario.controller.kind,
        reference=scenario.reference.kind,
        duration=scenario.duration,
        imperfections=tuple(key for key, value in parts if value != getattr(off, key)),
        events=tuple(event.kind for event in scenario.events),
    )
