"""What margins are to be searched: controllers times rows times seeds, validated before any run."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dnnmso_mj.comparison.plan import controller_point
from dnnmso_mj.margins.rows import ROWS, MarginError, is_model_free
from dnnmso_mj.margins.search import PRECISION, Found, find_margin
from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.simulation import simulate
from dnnmso_mj.sweep.plan import code_identity
from dnnmso_mj.sweep.task import Row, failed_row
from dnnmso_mj.wording import clean

LIMIT = 0.02  # rad


@dataclass(frozen=True)
class Cell:
    """One controller and one row of its card.

    Args:
        controller: its name, as the caller gave it.
        row: a key of `ROWS`.
        scenario: with that controller; its seed is replaced by each of the plan's.
        mjcf: the model that it names.
    """

    controller: str
    row: str
    scenario: Scenario
    mjcf: Mjcf


@dataclass(frozen=True)
class MarginPlan:
    """Validated margins.

    Args:
        source: the scenario as the caller named it.
        seeds: ascending, each once.
        points: by controller, then row.
        limit: the largest `rmse_steady` that counts as standing (rad).
    """

    source: str
    seeds: tuple[int, ...]
    points: tuple[Cell, ...]
    limit: float

    @property
    def n_runs(self) -> int:
        """How many rows the finished table has."""
        return len(self.points) * len(self.seeds)

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of rows, in the card's order."""
        return tuple(dict.fromkeys(cell.row for cell in self.points))

    @property
    def controllers(self) -> dict[str, Scenario]:
        """Scenarios by the names of their controllers."""
        return {cell.controller: cell.scenario for cell in self.points}

    def tasks(self, done: Sequence[Set[int]]) -> Iterator[MarginTask]:
        """What is left to search, one search a task.

        Args:
            done: for each point, the seeds that have a row already.
        """
        for k, cell in enumerate(self.points):
            for seed in self.seeds:
                if seed not in done[k]:
                    yield MarginTask(k, cell.scenario, cell.mjcf, cell.row, self.limit, (seed,))

    def definition(self) -> dict[str, Any]:
        """Everything but the seeds that the numbers depend on, as JSON."""
        scenarios = {
            name: scenario.model_dump(mode="json", exclude={"seed"})
            for name, scenario in self.controllers.items()
        }
        return {
            "points": [{"controller": cell.controller, "row": cell.row} for cell in self.points],
            "limit": self.limit,
            "precision": PRECISION,
            "scenarios": scenarios,
            "models": {c.scenario.plant.model: c.mjcf.text for c in self.points},
            **code_identity(self.controllers.values()),
        }


@dataclass(frozen=True)
class MarginTask:
    """The margin of one point, once for each seed.

    Args:
        point: its number.
        scenario, mjcf, row, limit: see `Cell` and `MarginPlan`.
        seeds: one search each.
    """

    point: int
    scenario: Scenario
    mjcf: Mjcf
    row: str
    limit: float
    seeds: tuple[int, ...]

    def __call__(self) -> Iterator[Row]:
        """Search with each seed in turn; a search that raises is a row with its reason."""
        for seed in self.seeds:
            started = time.perf_counter()
            try:
                row = self._search(seed)
            except Exception as error:
                row = failed_row(self.point, seed, f"{type(error).__name__}: {error}")
            yield row | {"wall_s": time.perf_counter() - started}

    def _search(self, seed: int) -> Row:
        spec, scenario = ROWS[self.row], self.scenario.model_copy(update={"seed": seed})
        row = {"point": self.point, "seed": seed, "status": "unused", "ticks": 0, "runs": 0}
        reason = spec.unused(scenario)
        if reason:
            return row | {"reason": reason}
        why, ticks = [""], 0

        def stands(level: float) -> bool:
            nonlocal ticks
            trace = simulate(spec.changed(scenario, level), self.mjcf, watch=False)
            ticks += len(trace)
            error = compute_metrics(trace)["rmse_steady"]
            stood = trace.info.status == "ok" and error is not None and error <= self.limit
            if level == 0.0 and not stood:
                why[0] = trace.info.reason or f"rmse_steady = {error:.4g} rad"
            return stood

        found = find_margin(stands, spec.start, spec.cap)
        return row | _described(found, self.row) | {"reason": why[0], "ticks": ticks}


def plan_margins(
    source: str | Path,
    controllers: Sequence[str],
    rows: Sequence[str],
    seeds: Sequence[int],
    sets: Sequence[str] = (),
    limit: float = LIMIT,
    *,
    trust: bool = False,
) -> MarginPlan:
    """Validate every controller and row, down to the first tick of a run.

    Args:
        source: a scenario file, or the name of a shipped one.
        controllers: each the name of a shipped tuned controller, a kind (its defaults), or a file.
        rows: keys of `ROWS`.
        seeds: of initial weights and noise; ascending.
        sets: "a.b=c", for every controller.
        limit: the largest `rmse_steady` that counts as standing (rad), the same for all.
        trust: whether the scenario may name code by import path, as `load_scenario`.

    Raises:
        ScenarioError: as `load_scenario`; the place of a controller is `--controllers NAME`.
        MarginError: no controller, one twice, a row that the scenario cannot have, or no limit.
    """
    twice = [name for k, name in enumerate(controllers) if name in controllers[:k]]
    if twice or not all(controllers) or not controllers:
        wrong = f"{clean(twice[0])} is there twice" if twice else "an empty name"
        raise MarginError(f"--controllers: {wrong}; allowed: each controller once, as in a,b,c")
    if not 0.0 < limit < math.inf:
        raise MarginError(f"--limit {limit:g}: allowed: a finite number above 0 (rad)")
    points: list[Cell] = []
    models: dict[str, Mjcf] = {}
    for name in controllers:
        point = controller_point(source, name, sets, models, trust)
        scenario, mjcf = point.scenario, point.mjcf
        for row in rows:
            spec = ROWS[row]
            if not spec.unused(scenario):
                spec.changed(scenario, spec.cap)
                _first_tick(spec.changed(scenario, spec.start), mjcf)
            points.append(Cell(name, row, scenario, mjcf))
    return MarginPlan(str(source), tuple(seeds), tuple(points), limit)


def model_free(plan: MarginPlan) -> tuple[str, ...]:
    """Controllers without a nominal model."""
    return tuple(name for name, s in plan.controllers.items() if is_model_free(s.controller))


def _first_tick(scenario: Scenario, mjcf: Mjcf) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore"
        )  # of the run itself; what is strange of the scenario is told
        simulate(scenario.model_copy(update={"duration": scenario.dt}), mjcf, watch=False)


def _described(found: Found, row: str) -> Row:
    """A search's end in the row's own unit."""
    value = ROWS[row].value
    return {
        "status": found.status,
        "margin": value(found.margin) if found.margin else None,
        "fails_at": value(found.fails_at) if found.fails_at else None,
        "non_monotone": found.non_monotone,
        "runs": found.runs,
    }
