"""Small sweeps, what two tables must share, and scenarios that take their process along."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa

from dnnmso_mj.scenario import Scenario
from dnnmso_mj.sweep.plan import Plan, plan_sweep
from dnnmso_mj.sweep.table import TIMING

DNNMSO = Path(sys.executable).with_name("dnnmso")
DEADLY_SEED = 3
SMALL_SETS = ["duration=0.12", "controller.observer.K2=300"]
SMALL_GRID = ["controller.observer.feedback=stable,as_printed", "plant.gravity=9.81,1.62"]


def small_plan(seeds: int = 10) -> Plan:
    """Four grid points of short runs; of the last two, every run diverges."""
    return plan_sweep("paper", range(seeds), SMALL_SETS, SMALL_GRID)


def untimed(table: pa.Table) -> pa.Table:
    """What does not depend on the clock, and must be the same however a table was made."""
    return table.drop_columns(list(TIMING)).replace_schema_metadata(None)


class Deadly(Scenario):
    """A scenario whose run of one seed is a segmentation fault of its process."""

    def model_copy(self, *, update: Any = None, deep: bool = False) -> Scenario:
        if update["seed"] == DEADLY_SEED:
            ctypes.string_at(0)
        return super().model_copy(update=update, deep=deep)


class DeadlyOnce(Scenario):
    """A scenario whose run of one seed is killed the first time, as if memory had run out.

    Its description names the file that remembers it.
    """

    def model_copy(self, *, update: Any = None, deep: bool = False) -> Scenario:
        memory = Path(self.description)
        if update["seed"] == DEADLY_SEED and not memory.exists():
            memory.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().model_copy(update=update, deep=deep)


class Parent(Scenario):
    """A scenario whose runs start a process that outlasts them.

    Its description names the file that has the process's number.
    """

    def model_copy(self, *, update: Any = None, deep: bool = False) -> Scenario:
        sleeper = subprocess.Popen(["sleep", "600"])
        Path(self.description).write_text(str(sleeper.pid))
        return super().model_copy(update=update, deep=deep)


def with_scenario(plan: Plan, kind: type[Scenario], **changes: Any) -> Plan:
    """The plan with every point's scenario as one of `kind`."""
    points = tuple(
        replace(point, scenario=kind.model_construct(**(dict(point.scenario) | changes)))
        for point in plan.points
    )
    return replace(plan, points=points)


def dnnmso(*args: object, cwd: Path, **options: Any) -> subprocess.CompletedProcess[str]:
    command = [str(DNNMSO), *map(str, args)]
    return subprocess.run(
        command, cwd=cwd, capture_output=True, text=True, check=False, timeout=120, **options
    )


def foreign_modules(folder: Path) -> None:
    """Put modules into `folder` that end the process that imports one of them."""
    (folder / "dnnmso_mj").mkdir()
    for name in ("dnnmso_mj/__init__.py", "random.py"):
        (folder / name).write_text("raise SystemExit('foreign code')")


def rows_in(journal: Path) -> int:
    """Whole rows that a journal holds."""
    return max(0, journal.read_bytes().count(b"\n") - 1) if journal.exists() else 0


def children(pid: int) -> list[int]:
    """Processes that `pid` has started."""
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def wait_until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing happened in time"
        time.sleep(0.01)
