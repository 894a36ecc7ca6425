"""The search: trial after trial on the same seeds, the untuned controller first."""

from __future__ import annotations

import datetime
import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from dnnmso_mj import __version__
from dnnmso_mj.comparison.plan import CHOICES
from dnnmso_mj.loading import controller_kinds, controller_set, kind_set, load_scenario
from dnnmso_mj.loading.overrides import parse_overrides
from dnnmso_mj.loading.shape import lookup
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.provenance import software_versions
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.scenario.tuned import Tuning
from dnnmso_mj.sources import sources_digest
from dnnmso_mj.sweep.local import LocalEngine, WorkerPool
from dnnmso_mj.sweep.plan import (
    NUMBERS_DEPEND_ON,
    check_keys,
    ordered_seeds,
    ready_point,
    seeds_text,
)
from dnnmso_mj.sweep.task import Row, Task
from dnnmso_mj.tuning import TuneError
from dnnmso_mj.tuning.objective import Objective
from dnnmso_mj.tuning.spaces import SPACES, Range, Space
from dnnmso_mj.tuning.study import Study, Values
from dnnmso_mj.tuning.winner import check_out, write_tuned
from dnnmso_mj.wording import clean, show


class Watcher(Protocol):
    """Looks on while a tuning runs."""

    def begin(self, total: int, kept: int) -> None:
        """`kept` of `total` trials are there already."""

    def trial(self, done: int, value: float, best: float) -> None:
        """One more trial is kept."""


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
        command: what a person would type for it; kept in the file.
    """

    source: str
    controller: str
    seeds: Sequence[int]
    trials: int
    sets: Sequence[str] = ()
    objective: Objective = field(default_factory=Objective)
    test_seeds: Sequence[int] = ()
    command: str = ""


@dataclass(frozen=True)
class Tuned:
    """A finished tuning.

    Args:
        out, storage: the file of the best trial, and of all trials.
        kept: trials that were there before.
        best: number of the best trial, from 0, the untuned controller.
        parameters: key path -> value of the best trial.
        value, start_value: the objective of the best and of the first trial.
        test_value, test_start_value: the same on the test seeds; None without any.
        scenario: with the best controller in place.
    """

    out: Path
    storage: Path
    kept: int
    best: int
    parameters: Values
    value: float
    start_value: float
    test_value: float | None
    test_start_value: float | None
    scenario: Scenario


def default_storage(out: Path) -> Path:
    """Beside the file to be."""
    return out.with_name(f"{out.stem}.study.sqlite")


def tune(
    request: Request,
    out: Path,
    storage: Path | None = None,
    *,
    jobs: int | None = None,
    resume: bool = False,
    force: bool = False,
    watcher: Watcher | None = None,
) -> Tuned:
    """Search, and write the best controller to `out`.

    An exception on the way, Ctrl-C too, leaves every finished trial in `storage` for `resume`,
    which comes to the same controller as a search without interruption.

    Args:
        request: what for.
        out: the file to be.
        storage: of the trials; by default `default_storage`.
        jobs: runs at once; None takes every core.
        resume: go on with the study that is there; start one where none is.
        force: start anew whatever study or tuned controller is there.
        watcher: told of every trial.

    Raises:
        MissingExtraError: Optuna is not installed.
        ScenarioError: as `load_scenario`.
        TuneError: what is asked for cannot be tuned, or a file is taken or of another tuning.
    """
    _check(request, resume, force)
    check_out(out, replace=resume or force)
    search = _Search(request)
    storage = storage or default_storage(out)
    name = f"{request.controller} on {search.scenario.name}"
    jobs = LocalEngine(jobs).jobs
    with (
        WorkerPool(jobs) as pool,
        Study(
            storage,
            name,
            search.definition(),
            search.space,
            search.start,
            resume=resume,
            force=force,
        ) as study,
    ):
        kept = study.n_done
        if kept > request.trials:
            allowed = f"allowed: {kept} or more, or --force to start anew"
            raise TuneError(
                f"--trials {request.trials}: {storage} has {kept} trials already; {allowed}"
            )
        if watcher is not None:
            watcher.begin(request.trials, kept)
        while study.n_done < request.trials:
            _one_trial(study, search, pool, watcher)
        best, parameters, value = study.best
        start_value = study.values()[0]
        tested = [
            search.value(search.runs(pool, values, request.test_seeds))
            for values in (parameters, search.start)
            if request.test_seeds
        ]
    scenario = search.with_values(parameters)
    write_tuned(out, scenario.controller, search.record(name, value))
    test_value, test_start_value = tested or (None, None)
    return Tuned(
        out=out,
        storage=storage,
        kept=kept,
        best=best,
        parameters=parameters,
        value=value,
        start_value=start_value,
        test_value=test_value,
        test_start_value=test_start_value,
        scenario=scenario,
    )


def _check(request: Request, resume: bool, force: bool) -> None:
    if resume and force:
        raise TuneError("--resume and --force: one goes on, one starts anew; allowed: one of them")
    if request.trials < 1:
        raise TuneError(f"--trials {request.trials}: allowed: 1 or more")
    shared = sorted(set(request.seeds) & set(request.test_seeds))
    if shared:
        raise TuneError(
            f"--test-seeds: {show(seeds_text(shared))[1:-1]} are tuning seeds too; allowed: seeds "
            "that tuning never sees, as in --seeds 1000:1010 --test-seeds 0:100"
        )
    overrides = parse_overrides(request.sets)
    check_keys(overrides)
    for item in overrides:
        if item.path in CHOICES:
            where = f"{item.place}: chooses a controller"
            raise TuneError(f"{where}, as --controller does; allowed: --controller alone")


def _one_trial(study: Study, search: _Search, pool: WorkerPool, watcher: Watcher | None) -> None:
    trial, values = study.ask()
    try:
        rows = search.runs(pool, values, search.seeds)
        first = next((row for row in rows if row["status"] == "failed"), None)
        if first is not None and study.n_done == 0:
            raise TuneError(f"the untuned controller, seed {first['seed']}: {first['reason']}")
        value = search.value(rows)
    except BaseException:
        study.tell(trial, None)
        raise
    study.tell(trial, value)
    if watcher is not None:
        watcher.trial(study.n_done, value, study.best[2])


class _Search:
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
        self.scenario = load_scenario(request.source, self._sets)
        models: dict[str, Mjcf] = {}
        self._point = ready_point(self.scenario, parse_overrides(request.sets), models)
        self.start, self.space = _space(self.scenario, self._sets)

    def with_values(self, values: Values) -> Scenario:
        """The scenario of a trial."""
        if values == self.start:
            return self.scenario
        tried = [f"controller.{path}={value!r}" for path, value in values.items()]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of gains that the search tries and finds wanting
            return load_scenario(self._request.source, [*self._sets, *tried])

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
    for path, reach in SPACES[data["kind"]].items():
        keys = tuple(path.split("."))
        if any(of and keys[: len(of)] == of for of in held):
            continue
        start[path] = _number(f"controller.{path}", lookup(data, keys), reach)
        low, high = min(reach.low, start[path]), max(reach.high, start[path])
        space[path] = Range(low, high, reach.log)
    if not space:
        kind = data["kind"]
        every = ", ".join(SPACES[kind])
        raise TuneError(f"--set: holds all that is tuned of {kind}: {every}; allowed: fewer")
    return start, space


def _number(path: str, value: Any, reach: Range) -> float:
    """The one number that is tuned; a list of one stands for all joints."""
    one = value[0] if isinstance(value, list) and len(value) == 1 else value
    if isinstance(one, bool) or not isinstance(one, int | float) or not math.isfinite(one):
        raise TuneError(f"{clean(path)} = {show(value)}: one number is tuned; allowed: a number")
    if reach.log and one <= 0:
        raise TuneError(f"{clean(path)} = {show(value)}: tuned by its logarithm; allowed: > 0")
    return float(one)
