"""The trials of one tuning, kept by Optuna in an SQLite file, whatever happens to the process.

Each trial is sampled with a seed of its own, so that a study that was interrupted and gone on with
makes the same trials as one that was not.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Self

from dnnmso_mj.errors import DnnmsoError, MissingExtraError
from dnnmso_mj.extras import pip_install
from dnnmso_mj.interrupts import held_back
from dnnmso_mj.sweep.journal import differences
from dnnmso_mj.tuning import TuneError
from dnnmso_mj.tuning.spaces import Space
from dnnmso_mj.wording import clean

if TYPE_CHECKING:
    import optuna

ATTRIBUTE = "dnnmso_tune"  # of a study: what it tunes
DIGEST = "sha256"  # of a trial: what was tried, and its value
SAMPLER_SEED = 0
DIGITS = 4  # of a value that is tried, so that what is written is what was tried
LISTED = 8

Values = dict[str, float]


class Study:
    """A context manager that holds the storage for itself.

    Args:
        path: the SQLite file.
        name: of the study in it.
        definition: everything that a trial's value depends on, as JSON.
        space: what is tuned.
        start: the values of the first trial.
        resume: whether to go on with what the file holds.
        force: whether to start anew whatever study of ours it holds.

    Raises:
        MissingExtraError: Optuna is not installed.
        TuneError: the file is taken, in use, of another tuning, or no study of ours.
    """

    def __init__(
        self,
        path: Path,
        name: str,
        definition: dict[str, Any],
        space: Space,
        start: Values,
        *,
        resume: bool = False,
        force: bool = False,
    ) -> None:
        self._optuna = import_optuna()
        self._path, self._space, self._start = path, space, start
        exists = path.exists()
        if exists and not (resume or force):
            ways = "allowed: --resume to go on, --force to start anew, or another --storage"
            raise TuneError(f"{path}: a study is there; {ways}")
        self._file = _lock(path)
        try:
            with held_back():
                with _reading(path):
                    found = self._open() if exists else None
                if found is not None and force:
                    with path.open("r+b") as stream:
                        stream.truncate()
                    found = None
                self._study = found or self._new(name, definition)
                with _reading(path):
                    self._check(definition)
        except BaseException:
            if not exists:
                path.unlink(missing_ok=True)
            os.close(self._file)
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        os.close(self._file)

    @property
    def n_done(self) -> int:
        """How many trials have a value."""
        return len(self._done())

    @property
    def best(self) -> tuple[int, Values, float]:
        """The best trial: its number among those that are done, what was tried, its value."""
        values = self.values()
        k = values.index(min(values))
        return k, self._rounded(self._done()[k].params), values[k]

    def values(self) -> list[float]:
        """Of every trial that is done, in order."""
        return [trial.value for trial in self._done() if trial.value is not None]

    def ask(self) -> tuple[optuna.Trial, Values]:
        """Begin a trial: what to tell the value to, and what to try."""
        with _writing(self._path):
            trial = self._asked()
        return trial, self._rounded(trial.params)

    def _asked(self) -> optuna.Trial:
        optuna, done = self._optuna, self.n_done
        self._study.sampler = optuna.samplers.TPESampler(
            seed=SAMPLER_SEED + done, multivariate=True
        )
        states = (optuna.trial.TrialState.WAITING,)
        if done == 0 and not self._study.get_trials(deepcopy=False, states=states):
            self._study.enqueue_trial(dict(self._start))
        return self._study.ask({
            path: optuna.distributions.FloatDistribution(reach.low, reach.high, log=reach.log)
            for path, reach in self._space.items()
        })  # fmt: skip

    def tell(self, trial: optuna.Trial, value: float | None) -> None:
        """Keep a trial's value; None: it was interrupted, and does not count."""
        state = self._optuna.trial.TrialState.FAIL if value is None else None
        with _writing(self._path):
            if value is not None:
                trial.set_user_attr(DIGEST, _digest(trial.params, value))
            self._study.tell(trial, value, state=state)

    def _done(self) -> list[optuna.trial.FrozenTrial]:
        complete = (self._optuna.trial.TrialState.COMPLETE,)
        with held_back():
            return self._study.get_trials(deepcopy=False, states=complete)

    def _rounded(self, params: Mapping[str, float]) -> Values:
        return {
            path: value if value == self._start[path] else float(f"{value:.{DIGITS}g}")
            for path, value in params.items()
        }

    def _storage(self) -> optuna.storages.RDBStorage:
        from sqlalchemy import URL

        url = URL.create("sqlite", database=str(self._path.absolute()))
        storage: optuna.storages.RDBStorage = self._optuna.storages.RDBStorage(
            url.render_as_string()
        )
        return storage

    def _new(self, name: str, definition: dict[str, Any]) -> optuna.Study:
        with _writing(self._path):
            study: optuna.Study = self._optuna.create_study(
                storage=self._storage(), study_name=name
            )
            study.set_user_attr(ATTRIBUTE, json.dumps(definition))
        return study

    def _open(self) -> optuna.Study:
        """The study that is there; what a kill left under way in it is given up."""
        from sqlalchemy.exc import SQLAlchemyError

        study: optuna.Study | None = None
        # Opening makes Optuna's tables in a database of something else: look before.
        if self._path.read_bytes()[:16] in {b"", b"SQLite format 3\0"} and _has_studies(self._path):
            with suppress(KeyError, SQLAlchemyError, RuntimeError):
                study = self._optuna.load_study(study_name=None, storage=self._storage())
        if study is None or ATTRIBUTE not in study.user_attrs:
            raise TuneError(
                f"{self._path}: exists and is not a study of `dnnmso tune`, so nothing is written "
                "over it; allowed: another --storage, or remove it first"
            )
        state = self._optuna.trial.TrialState
        with _writing(self._path):
            for trial in study.get_trials(deepcopy=False, states=(state.RUNNING,)):
                study.tell(trial.number, state=state.FAIL)
        return study

    def _check(self, definition: dict[str, Any]) -> None:
        for trial in self._done():
            if trial.user_attrs.get(DIGEST) != _digest(trial.params, trial.value):
                raise ValueError(f"trial {trial.number} is not what was written")
        before = json.loads(self._study.user_attrs[ATTRIBUTE])
        found = list(differences(before, json.loads(json.dumps(definition)), ""))
        if found:
            more = [f"… and {len(found) - LISTED} more"] if len(found) > LISTED else []
            listed = "\n  ".join(found[:LISTED] + more)
            raise TuneError(
                f"{self._path}: --resume: the study there is of another tuning:\n  {listed}\n"
                "allowed: the same scenario, seeds, objective and software; or --force, or another "
                "--storage"
            )


def import_optuna() -> ModuleType:
    """Optuna, silent.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import optuna
    except ImportError as error:
        raise MissingExtraError(
            f"dnnmso tune needs optuna, which is not installed: {pip_install('tune')}"
        ) from error
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    module: ModuleType = optuna
    return module


def _digest(params: Mapping[str, float], value: float | None) -> str:
    """SQLite does not notice a bit that a disk has flipped."""
    return hashlib.sha256(json.dumps([sorted(params.items()), value]).encode()).hexdigest()


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """A database that cannot be written is one error, not the library's many.

    SQLAlchemy makes an AssertionError of a Ctrl-C in the middle of a commit: it waits.
    """
    from optuna.exceptions import StorageInternalError
    from sqlalchemy.exc import SQLAlchemyError

    try:
        with held_back():
            yield
    except (OSError, SQLAlchemyError, StorageInternalError) as error:
        cause = getattr(error, "orig", None) or error.__cause__ or error
        why = str(getattr(cause, "orig", None) or cause).splitlines()[0]
        raise TuneError(
            f"{path}: cannot be written: {why}; finished trials are kept; --resume goes on"
        ) from error


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """A damaged study is one error, whatever the libraries stumble over."""
    try:
        yield
    except DnnmsoError:
        raise
    except Exception as error:
        why = (str(getattr(error, "orig", None) or error).splitlines() or [""])[0]
        raise TuneError(
            f"{path}: the study is damaged: {type(error).__name__}: {clean(why)}; allowed: another "
            "--storage, or remove it first"
        ) from error


def _has_studies(path: Path) -> bool:
    import sqlite3

    with suppress(sqlite3.Error):
        connection = sqlite3.connect(path)
        try:
            found = connection.execute("SELECT name FROM sqlite_master WHERE name = 'studies'")
            return found.fetchone() is not None
        finally:
            connection.close()
    return False


def _lock(path: Path) -> int:
    """Open the file, and hold it until it is closed: SQLite's own locks are of another sort."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise TuneError(f"{path}: cannot be written: {error.strerror}") from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(file)
        ways = "allowed: wait for it, or another --storage"
        raise TuneError(f"{path}: another tuning is writing it now; {ways}") from error
    return file
