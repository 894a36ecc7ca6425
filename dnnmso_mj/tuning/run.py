"""The search: trial after trial on the same seeds, the untuned controller first."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from dnnmso_mj.comparison.plan import CHOICES
from dnnmso_mj.loading.overrides import parse_overrides
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.sweep.local import LocalEngine, WorkerPool
from dnnmso_mj.sweep.plan import check_keys, seeds_text
from dnnmso_mj.tuning import TuneError, TuneInterrupted
from dnnmso_mj.tuning.search import Request, Search
from dnnmso_mj.tuning.study import Study, Values, import_optuna
from dnnmso_mj.tuning.winner import check_out, write_tuned
from dnnmso_mj.wording import show


class Watcher(Protocol):
    """Looks on while a tuning runs."""

    def begin(self, total: int, kept: int) -> None:
        """`kept` of `total` trials are there already."""

    def trial(self, done: int, value: float, best: float) -> None:
        """One more trial is kept."""


@dataclass(frozen=True)
class Tuned:
    """A finished tuning.

    Args:
        out, storage: the file of the best trial, and of all trials.
        kept: trials that were there before.
        best: number of the best trial, from 0, the untuned controller.
        parameters: key path -> value of the best trial; of a list, the factor.
        scenario: with the best controller in place.
        value, start_value: the objective of the best and of the first trial.
        test_value, test_start_value: the same on the test seeds; None without any.
    """

    out: Path
    storage: Path
    kept: int
    best: int
    parameters: Values
    scenario: Scenario
    value: float
    start_value: float
    test_value: float | None
    test_start_value: float | None


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

    An exception on the way leaves every finished trial in `storage` for `resume`, which comes to
    the same controller as a search without interruption.

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
        TuneInterrupted: Ctrl-C.
    """
    _check(request, resume, force)
    import_optuna()  # before seconds of compiling
    check_out(out, replace=resume or force)
    search = Search(request)
    storage, name = storage or default_storage(out), f"{request.controller} on {search.name}"
    trials = (search.definition(), search.space, search.start)
    with (
        WorkerPool(LocalEngine(jobs).jobs) as pool,
        Study(storage, name, *trials, resume=resume, force=force) as study,
    ):
        try:
            kept = study.n_done
            _refuse_fewer(request.trials, kept, storage)
            if watcher is not None:
                watcher.begin(request.trials, kept)
            while study.n_done < request.trials:
                _one_trial(study, search, pool, watcher)
            best, parameters, value = study.best
            tested = [
                search.value(search.runs(pool, values, request.test_seeds))
                for values in (parameters, search.start)
                if request.test_seeds
            ]
        except KeyboardInterrupt as stop:
            raise TuneInterrupted(study.n_done) from stop
        values = (value, study.values()[0], *(tested or (None, None)))
    scenario = search.with_values(parameters)
    write_tuned(out, scenario.controller, search.record(name, value))
    return Tuned(out, storage, kept, best, parameters, scenario, *values)


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


def _refuse_fewer(trials: int, kept: int, storage: Path) -> None:
    if kept > trials:
        allowed = f"allowed: {kept} or more, or --force to start anew"
        raise TuneError(f"--trials {trials}: {storage} has {kept} trials already; {allowed}")


def _one_trial(study: Study, search: Search, pool: WorkerPool, watcher: Watcher | None) -> None:
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
