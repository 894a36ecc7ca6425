"""A sweep from its plan to its table: rows are kept as they come, whatever engine makes them."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import pyarrow as pa

from dnnmso_mj.paths import logs_dir
from dnnmso_mj.provenance import software_versions
from dnnmso_mj.sweep.journal import Journal
from dnnmso_mj.sweep.local import LocalEngine
from dnnmso_mj.sweep.plan import Plan, SweepError, seeds_text
from dnnmso_mj.sweep.table import finished_table
from dnnmso_mj.sweep.task import Row, Task
from dnnmso_mj.wording import show


class Engine(Protocol):
    """Where runs are made."""

    @property
    def name(self) -> str:
        """As `--engine` takes it."""

    @property
    def jobs(self) -> int:
        """How many runs go on at once, once `rows` has begun."""

    def rows(self, tasks: Iterable[Task]) -> Generator[Row]:
        """Yield one row a run in any order; being closed stops the work."""


class Watcher(Protocol):
    """Looks on while a sweep runs."""

    def begin(self, total: int, kept: int) -> None:
        """`kept` of `total` rows are there already."""

    def row(self, row: Row) -> None:
        """One more row is safe."""


@dataclass(frozen=True)
class SweepResult:
    """A finished sweep.

    Args:
        out: the Parquet file.
        table: what it holds: one row a run, by grid point, then seed.
        kept: rows that were there before.
        ticks: control steps of the rows that were not.
        wall_s: from the first task to the written table (s).
        jobs: runs at once.
    """

    out: Path
    table: pa.Table
    kept: int
    ticks: int
    wall_s: float
    jobs: int


def make_engine(name: str = "local", jobs: int | None = None, address: str | None = None) -> Engine:
    """The engine of that name.

    Args:
        name: "local" or "ray".
        jobs: runs at once; None takes every core there is.
        address: of a Ray cluster, "auto" or HOST:PORT; None starts Ray on this machine alone.

    Raises:
        SweepError: no such engine, or one without an address that is given one.
        MissingExtraError: Ray is not installed.
    """
    if name == "ray":
        from dnnmso_mj.sweep.on_ray import RayEngine

        return RayEngine(jobs, address)
    if name != "local":
        raise SweepError(f"--engine {show(name)}: no such engine; allowed: local, ray")
    if address is not None:
        raise SweepError(f"--address {address}: only for a cluster; allowed: with --engine ray")
    return LocalEngine(jobs)


def default_out(plan: Plan) -> Path:
    """logs/NAME.parquet under the current directory."""
    return logs_dir() / f"{plan.points[0].scenario.name}.parquet"


def run_sweep(
    plan: Plan,
    out: Path | None = None,
    engine: Engine | None = None,
    *,
    resume: bool = False,
    force: bool = False,
    watcher: Watcher | None = None,
    command: str = "",
) -> SweepResult:
    """Run what a plan asks for and leave one Parquet table.

    The table is the same, but for the columns in `table.TIMING`, whatever the engine, the number of
    workers, the order, and however often the sweep was interrupted and gone on with. An exception
    on the way, Ctrl-C too, leaves the finished rows in OUT.journal for `resume`.

    Args:
        plan: from `plan_sweep`.
        out: the table; by default `default_out`.
        engine: from `make_engine`; by default every core of this machine.
        resume: go on from what is there; start where nothing is.
        force: start anew whatever is there.
        watcher: told of every row.
        command: what a person would type for this sweep; kept in the table's metadata.

    Raises:
        SweepError: `out` is taken or cannot be written, what is there is of another sweep, or the
            workers cannot be started.
    """
    refuse_both(resume, force)
    out, engine = out or default_out(plan), engine or LocalEngine()
    started = time.perf_counter()
    with Journal(out, plan, resume=resume, force=force) as journal:
        kept = journal.n_done
        rows, ticks = complete(
            journal, plan.n_runs, lambda: engine.rows(plan.tasks(journal.done)), watcher
        )
        table = finished_table(rows, plan, _provenance(plan, engine, command))
        journal.publish(table)
    wall_s = time.perf_counter() - started
    return SweepResult(out, table, kept, ticks, wall_s, engine.jobs)


def refuse_both(resume: bool, force: bool) -> None:
    """Refuse to go on and to start anew at once.

    Raises:
        SweepError: both are asked for.
    """
    if resume and force:
        raise SweepError("--resume and --force: one goes on, one starts anew; allowed: one of them")


def complete(
    journal: Journal, n_runs: int, make: Callable[[], Generator[Row]], watcher: Watcher | None
) -> tuple[pa.Table, int]:
    """Add to a journal the rows that it lacks.

    Args:
        journal: of finished rows.
        n_runs: how many there are to be.
        make: starts to yield those that are missing.
        watcher: told of every row.

    Returns:
        All rows, and how many ticks the new ones took.

    Raises:
        SweepError: rows are missing at the end.
    """
    ticks = 0
    if watcher is not None:
        watcher.begin(n_runs, journal.n_done)
    if journal.n_done < n_runs:
        with closing(make()) as rows:
            for row in rows:
                journal.append(row)
                ticks += row["ticks"]
                if watcher is not None:
                    watcher.row(row)
    table = journal.rows()
    if not len(table) == journal.n_done == n_runs:
        raise SweepError(
            f"{journal.out}: {len(table)} rows of {journal.n_done} runs; allowed: {n_runs}, "
            "one a run; --resume makes what is missing"
        )
    return table, ticks


def _provenance(plan: Plan, engine: Engine, command: str) -> dict[str, Any]:
    """All that it takes to make the table again."""
    return {
        "command": command,
        "scenario": plan.source,
        "seeds": seeds_text(plan.seeds),
        "engine": engine.name,
        "software": software_versions(),
        "definition": plan.definition(),
    }
