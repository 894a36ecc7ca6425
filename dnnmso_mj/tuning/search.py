"""What is searched: a scenario with a controller in its place, and which of its numbers."""

from __future__ import annotations

import datetime
import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from dnnmso_mj import __version__
from dnnmso_mj.external.identity import code_digests
from dnnmso_mj.loading import controller_kinds, controller_set, kind_set, load_scenario
from dnnmso_mj.loading.overrides import parse_overrides
from dnnmso_mj.loading.shape import lookup
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.provenance import software_versions
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.scenario.tuned import Tuning
from dnnmso_mj.sources import sources_digest
from dnnmso_mj.sweep.local import WorkerPool
from dnnmso_mj.sweep.plan import NUMBERS_DEPEND_ON, ordered_seeds, ready_point, seeds_text
from dnnmso_mj.sweep.task import Row, Task
from dnnmso_mj.tuning import TuneError
from dnnmso_mj.tuning.objective import Objective
from dnnmso_mj.tuning.spaces import Range, Space, space_of
from dnnmso_mj.tuning.study import DIGITS, Values
from dnnmso_mj.wording import clean, show


@dataclass(frozen=True)
class Request:
    """What is to be tuned, for what.

    Args:
        source: a scenario file, or the name of a shipped one; its own controller has no part in it.
        controller: a kind, whose defaults are the first trial; or a shipped tuned controller or a
            file, whose values are.
        seeds: each trial's runs.
        trials: the budget, the first included.
        sets: "a.b=c", for every trial; a key that is set is not tuned.
        objective: what is minimised.
        test_seeds: of runs that no trial is judged by; the first and the best trial are.
        trust: whether the scenario may name code by import path, as `load_scenario`.
        command: what a person would type for it; kept in the file.
    """

    source: str
    controller: str
    seeds: Sequence[int]
    trials: int
    sets: Sequence[str] = ()
    objective: Objective = field(default_factory=Objective)
    test_seeds: Sequence[int] = ()
    trust: bool = False
    command: str = ""


class Search:
    """What a trial is made of.

    Args:
        request: what for.
    """

    def __init__(self, request: Request) -> None:
        self._request = request
        self.seeds = ordered_seeds(request.seeds)
        ordered_seeds(request.test_seeds or (0,))
        name = request.controller
        chosen = kind_set(name) if name in controller_kinds() else controller_set(name)
        self._sets = [chosen, *request.sets]
        self.scenario = load_scenario(request.source, self._sets, trust=request.trust)
        models: dict[str, Mjcf] = {}
        self._point = ready_point(self.scenario, parse_overrides(request.sets), models)
        self.name = self.scenario.name
        self.start, self.space = _space(self.scenario, self._sets)

    def with_values(self, values: Values) -> Scenario:
        """The scenario of a trial."""
        if values == self.start:
            return self.scenario
        tried = [f"controller.{path}={self._meant(path, value)}" for path, value in values.items()]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of gains that the search tries and finds wanting
            sets = [*self._sets, *tried]
            return load_scenario(self._request.source, sets, trust=self._request.trust)

    def _meant(self, path: str, value: float) -> str:
        """What a tried number stands for: itself, or the starting numbers times it."""
        if not self.space[path].factor:
            return repr(value)
        settings = self.scenario.model_dump(mode="json")["controller"]
        first = lookup(settings, tuple(path.split(".")))
        return repr([float(f"{value * one:.{DIGITS}g}") for one in first])

    def runs(self, pool: WorkerPool, values: Values, seeds: Iterable[int]) -> list[Row]:
        """One row a seed, by seed."""
        scenario = self.with_values(values)
        tasks = [Task(0, scenario, self._point.mjcf, (seed,)) for seed in seeds]
        return sorted(pool.rows(tasks), key=lambda row: int(row["seed"]))

    def value(self, rows: Sequence[Row]) -> float:
        """The objective."""
        return self._request.objective.value(rows, self.scenario.n_ticks)

    def definition(self) -> dict[str, Any]:
        """Everything that a trial's value depends on."""
        versions = software_versions()
        return {
            "scenario": self.scenario.model_dump(mode="json", exclude={"seed"}),
            "seeds": seeds_text(self.seeds),
            "objective": self._request.objective.words,
            "space": {path: list(reach) for path, reach in self.space.items()},
            "model": self._point.mjcf.text,
            "versions": {name: versions[name] for name in NUMBERS_DEPEND_ON},
            "source_sha256": sources_digest(),
            **({"outside": outside} if (outside := code_digests([self.scenario])) else {}),
        }

    def record(self, study: str, value: float) -> Tuning:
        """What the file says of how it was found."""
        request = self._request
        return Tuning(
            study=study,
            budget=request.trials,
            seeds=seeds_text(self.seeds),
            scenario=request.source,
            objective=request.objective.words,
            value=value,
            command=request.command,
            date=datetime.datetime.now(datetime.UTC).date().isoformat(),
            version=__version__,
        )


def _space(scenario: Scenario, sets: Sequence[str]) -> tuple[Values, Space]:
    """Where the search starts and what it spans: the kind's table without the keys that are set."""
    data = scenario.model_dump(mode="json")["controller"]
    held = [item.path[1:] for item in parse_overrides(sets) if item.path[0] == "controller"]
    start: Values = {}
    space: Space = {}
    every = space_of(data)
    for path, reach in every.items():
        keys = tuple(path.split("."))
        if any(of and keys[: len(of)] == of for of in held):
            continue
        first = 1.0 if reach.factor else lookup(data, keys)
        start[path] = _number(f"controller.{path}", first, reach)
        low, high = min(reach.low, start[path]), max(reach.high, start[path])
        space[path] = reach._replace(low=low, high=high)
    if not space:
        names = f"{data['kind']}: {', '.join(every)}"
        raise TuneError(f"--set: holds all that is tuned of {names}; allowed: fewer")
    return start, space


def _number(path: str, value: Any, reach: Range) -> float:
    """The one number that is tuned; a list of one stands for all joints."""
    one = value[0] if isinstance(value, list) and len(value) == 1 else value
    if isinstance(one, bool) or not isinstance(one, int | float) or not math.isfinite(one):
        raise TuneError(f"{clean(path)} = {show(value)}: one number is tuned; allowed: a number")
    if reach.log and one <= 0:
        raise TuneError(f"{clean(path)} = {show(value)}: tuned by its logarithm; allowed: > 0")
    return float(one)
