"""The audit of one controller with one seed: freeze, drive on, drive elsewhere, ask the model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from dnnmso_mj.audit.drift import learned_drift, true_drift
from dnnmso_mj.audit.frozen import other_trajectory, same_trajectory, window, without_model
from dnnmso_mj.audit.knowledge import knowledge
from dnnmso_mj.audit.portrait import Portrait, map_slices
from dnnmso_mj.audit.region import Region, region_of
from dnnmso_mj.audit.unseen import SETTLING, Unseen
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.simulation import Simulation
from dnnmso_mj.trace import Trace

Array = np.ndarray
Row = dict[str, Any]
State = Mapping[str, Array]
Errors = Mapping[str, dict[str, float | None]]

VISITED = 500  # states of the last learning that the model is asked about


@dataclass(frozen=True)
class Questions:
    """What every controller of an audit is asked.

    Args:
        at: freeze times (s), ascending.
        region: what has been visited by the first of them.
        unseen: other trajectories.
        near: states inside the region (N, 2n).
        outside: states beyond it (N, 2n).
    """

    at: tuple[float, ...]
    region: Region
    unseen: tuple[Unseen, ...]
    near: Array
    outside: Array


@dataclass(frozen=True)
class Subject:
    """Who is audited.

    Args:
        name: of the controller.
        scenario: with this controller; its seed and duration do not matter.
        mjcf: the model that it names.
    """

    name: str
    scenario: Scenario
    mjcf: Mjcf


@dataclass(frozen=True)
class Findings:
    """Of one controller and seed: one row a freeze time, and perhaps the last model's portrait.

    Each row holds `controller`, `at`, `seed`, `reason` (of a divergence on the same trajectory),
    `diverged` (names of the runs that did), `trajectories` (name -> `frozen` and `no_network` RMSE,
    rad), and the numbers in `summary.MEASURES`, None where a run diverged.
    """

    rows: tuple[Row, ...]
    portrait: Portrait | None


def examine(subject: Subject, questions: Questions, seed: int, *, draw: bool) -> Findings:
    """Audit one controller with one seed; `draw` asks for the portrait at the last freeze time."""
    scenario = subject.scenario.model_copy(update={"seed": seed})
    rows, portrait = [], None
    for at in questions.at:
        wanted = draw and at == questions.at[-1]
        row, portrait = _at(subject, scenario, questions, at, draw=wanted)
        rows.append(row)
    return Findings(tuple(rows), portrait)


def _at(
    subject: Subject, scenario: Scenario, questions: Questions, at: float, *, draw: bool
) -> tuple[Row, Portrait | None]:
    simulation, trace = _drive(same_trajectory(scenario, at, "all"), subject.mjcf)
    bare = without_model(scenario)
    row: Row = {"controller": subject.name, "at": at, "seed": scenario.seed}
    row["reason"] = trace.info.reason
    row["same_alone"] = _rmse(trace, at)
    row["same_fed"] = _rmse(_drive(same_trajectory(scenario, at, "model"), subject.mjcf)[1], at)
    row["same_none"] = _error(same_trajectory(bare, at, "all"), subject.mjcf, at)
    row |= dict.fromkeys(("knowledge_visited", "knowledge_near", "knowledge_outside"))
    portrait, trajectories = None, {}
    if len(trace) > round(at / scenario.dt):  # else it diverged while it was learning
        visit = _Visit(simulation, trace, at)
        row["knowledge_visited"] = visit.knows(visit.states)
        row["knowledge_near"] = visit.knows(questions.near)
        row["knowledge_outside"] = visit.knows(questions.outside)
        portrait = visit.portrait(subject.name) if draw else None
        state = simulation.controller.state()
        trajectories = {
            unseen.name: _elsewhere(subject.mjcf, scenario, bare, unseen, at, state)
            for unseen in questions.unseen
        }
    row |= _by_place(trajectories, questions.unseen)
    same = {name: {"frozen": row[name]} for name in ("same_alone", "same_fed", "same_none")}
    row["diverged"] = [
        name if kind == "frozen" else f"{name} ({kind})"
        for name, errors in (same | trajectories).items()
        for kind, error in errors.items()
        if error is None
    ]
    return row | {"trajectories": trajectories}, portrait


def _by_place(trajectories: Errors, unseen: tuple[Unseen, ...]) -> dict[str, float | None]:
    """One RMSE of all trajectories inside, and of all outside."""
    out = {}
    for place, inside in (("inside", True), ("outside", False)):
        errors = [trajectories.get(one.name, {}) for one in unseen if one.inside is inside]
        out[place] = _together([error.get("frozen") for error in errors])
        out[f"{place}_none"] = _together([error.get("no_network") for error in errors])
    return out


def _drive(scenario: Scenario, mjcf: Mjcf, state: State | None = None) -> tuple[Simulation, Trace]:
    """Run from the start, with the controller in `state` but its observer at the start."""
    simulation = Simulation(scenario, mjcf, watch=False)
    if state is not None:
        simulation.controller.restore(state)
    recorder = MemoryRecorder(simulation.layout, scenario.n_ticks)
    return simulation, recorder.trace(scenario, simulation.run(recorder))


@lru_cache(maxsize=64)
def _error(scenario: Scenario, mjcf: Mjcf, start: float) -> float | None:
    """`_rmse` of a run; kept, since a law without a model is asked the same at every freeze."""
    return _rmse(_drive(scenario, mjcf)[1], start)


class _Visit:
    """The last learning before a freeze, and the model that it left."""

    def __init__(self, simulation: Simulation, trace: Trace, at: float) -> None:
        dt, end = trace.scenario.dt, round(at / trace.scenario.dt)
        start = max(0, end - round(window(trace.scenario) / dt))
        some = np.linspace(start, end - 1, min(VISITED, end - start)).round().astype(int)
        self.t = trace["t"][some]
        self.states = np.hstack([trace["q"][some], trace["qd"][some]])
        self._simulation, self._at, self._seed = simulation, at, trace.scenario.seed

    def knows(self, states: Array) -> float | None:
        return knowledge(*self._drifts(states))

    def portrait(self, name: str) -> Portrait:
        f_true, f_hat = self._drifts(self.states)
        region = region_of(self.states)
        slices = map_slices(self._simulation.plant, self._simulation.controller, region)
        return Portrait(name, self._at, self._seed, slices, self.t, self.states, f_true, f_hat)

    def _drifts(self, states: Array) -> tuple[Array, Array]:
        simulation = self._simulation
        return true_drift(simulation.plant, states), learned_drift(simulation.controller, states)


def _elsewhere(
    mjcf: Mjcf, scenario: Scenario, bare: Scenario, unseen: Unseen, at: float, state: State
) -> dict[str, float | None]:
    """RMSE on an unseen trajectory, with the frozen model alone and without a model."""
    learned = _drive(other_trajectory(scenario, at, unseen), mjcf, state)[1]
    nothing = _error(other_trajectory(bare, at, unseen), mjcf, SETTLING)
    return {"frozen": _rmse(learned, SETTLING), "no_network": nothing}


def _rmse(trace: Trace, start: float) -> float | None:
    """Root of the mean square of q − q_ref (rad) from `start` (s) on; None of a run cut short."""
    first = round(start / trace.scenario.dt)
    if trace.info.status != "ok":
        return None
    error = trace["q"][first:] - trace["q_ref"][first:]
    return float(np.sqrt(np.mean(error**2)))


def _together(errors: list[float | None]) -> float | None:
    """One RMSE of several runs of equal length; None if there is none, or one diverged."""
    known = [error for error in errors if error is not None]
    if not known or len(known) < len(errors):
        return None
    return float(np.sqrt(np.mean(np.square(known))))
