"""SIGKILL of sweeps: finished rows stay, and `--resume` comes to the uninterrupted table."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from dnnmso_mj.sweep.journal import journal_path
from dnnmso_mj.sweep.local import LocalEngine
from dnnmso_mj.sweep.plan import Plan, plan_sweep
from dnnmso_mj.sweep.run import run_sweep
from dnnmso_mj.sweep.table import TIMING, read_table
from soak.forked import kill, start
from soak.killed import wait_for
from soak.tally import Form, Tally

SETS = ["duration=0.4", "controller.observer.K2=300"]
GRID = ["controller.observer.feedback=stable,as_printed"]  # the second diverges
SEEDS = 40
LIFE_S = 3.5  # of one that nobody kills


def plan() -> Plan:
    """Enough rows that kills fall among them; half of them diverge."""
    return plan_sweep("paper", range(SEEDS), SETS, GRID)


class Reporter:
    """Writes down each row once the sweep has said that it is safe."""

    def __init__(self, file: Path) -> None:
        self._file = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_APPEND)

    def begin(self, total: int, kept: int) -> None:
        """How many there are is of no interest here."""

    def row(self, row: dict[str, Any]) -> None:
        os.write(self._file, f"{json.dumps([row['point'], row['seed']])}\n".encode())


def sweep_reporting(out: str, told: str) -> None:
    """Begin, or go on with, the sweep."""
    run_sweep(plan(), Path(out), LocalEngine(2), resume=True, watcher=Reporter(Path(told)))


def kill_sweeps(form: Form, tally: Tally, folder: Path) -> None:
    """Chains of kills, each ended by a resume that nobody kills."""
    folder.mkdir()
    expected = untimed(run_sweep(plan(), folder / "all.parquet", LocalEngine(2)).table)
    chains, kills = form.pick(1, 14), form.pick(2, 2)

    def one(k: int) -> None:
        place = folder / f"chain-{k}"
        place.mkdir()
        rng = np.random.default_rng([form.seed, 7, k])
        for _ in range(kills):
            with tally.case(f"sweep {k}, seed {form.seed}"):
                kill_sweep(place, rng)
        with tally.case(f"sweep {k}, gone on with, seed {form.seed}"):
            go_on(place, expected)

    with ThreadPoolExecutor(form.pick(1, 2)) as pool:
        list(pool.map(one, range(chains)))


def untimed(table: pa.Table) -> pa.Table:
    """What must be the same however a table was made."""
    return table.drop_columns(list(TIMING)).replace_schema_metadata(None)


def kill_sweep(place: Path, rng: np.random.Generator) -> None:
    """All of its processes, itself alone, or one worker, at any instant."""
    out, told = place / "sweep.parquet", place / "told"
    process = start(sweep_reporting, str(out), str(told))
    time.sleep(rng.uniform(0.0, LIFE_S))
    how = rng.choice(["all", "the sweep", "a worker, then all"])
    workers = list(_below(process.pid or 0))
    if how == "a worker, then all" and workers:
        _end(int(rng.choice(workers)))
        time.sleep(rng.uniform(0.0, 1.0))
        workers = [*workers, *_below(process.pid or 0)]
    kill(process)
    if how != "the sweep":
        for pid in workers:
            _end(pid)
    check_rows(out, told)
    left = wait_for(lambda: not any(map(_runs, workers)), 10.0)
    assert left, "a worker outlives its sweep"


def check_rows(out: Path, told: Path) -> None:
    """Every row that was called safe is in the journal or the table.

    Raises:
        AssertionError: one is not.
    """
    safe = _lines(told)
    if journal_path(out).exists():
        kept = [(row.get("point"), row.get("seed")) for row in _rows(journal_path(out))]
        assert len(set(kept)) == len(kept), "a row is kept twice"
    elif out.exists():
        assert len(read_table(out)[0]) == 2 * SEEDS, "the table is not whole"
        return
    else:
        kept = []
    lost = {tuple(json.loads(line)) for line in safe} - set(kept)
    assert not lost, f"{len(lost)} of {len(safe)} finished rows are lost"


def go_on(place: Path, expected: pa.Table) -> None:
    """`--resume` without a kill.

    Raises:
        AssertionError: the table is not the uninterrupted one.
    """
    out = place / "sweep.parquet"
    process = start(sweep_reporting, str(out), str(place / "told"))
    process.join(120)
    assert process.exitcode == 0, f"--resume ended with {process.exitcode}"
    assert untimed(read_table(out)[0]).equals(expected), "the table is another one"
    assert not journal_path(out).exists(), "the journal is left"


def _rows(journal: Path) -> Iterator[dict[str, Any]]:
    """Whole rows of a journal."""
    whole, _, _ = journal.read_bytes().rpartition(b"\n")
    for line in whole.splitlines()[1:]:
        yield json.loads(line)


def _lines(file: Path) -> list[str]:
    return file.read_text().splitlines() if file.exists() else []


def _below(pid: int) -> Iterator[int]:
    """Processes that a process has started."""
    with suppress(OSError):
        text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
        yield from map(int, text.split())


def _runs(pid: int) -> bool:
    with suppress(OSError, IndexError):
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        return state not in "ZX"
    return False


def _end(pid: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
