"""The sections of a benchmark, run in order, and all that is told of them as one document."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any

from dnnmso_mj.bench.growth import bench_growth
from dnnmso_mj.bench.machine import load_average, machine, versions
from dnnmso_mj.bench.recording import bench_recording
from dnnmso_mj.bench.step import bench_step
from dnnmso_mj.bench.sweeping import bench_sweep
from dnnmso_mj.bench.tick import bench_tick
from dnnmso_mj.bench.timing import Table
from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.provenance import git_commit
from dnnmso_mj.wording import did_you_mean, show

SECTIONS: dict[str, Callable[[bool], list[Table]]] = {
    "step": bench_step,
    "tick": bench_tick,
    "sweep": bench_sweep,
    "recording": bench_recording,
    "growth": bench_growth,
}


class BenchError(DnnmsoError):
    """A benchmark that does not exist."""


@dataclass(frozen=True)
class Benchmark:
    """What was measured, where, when and with what.

    Args:
        quick: whether it was only tried out; the numbers mean little then.
        date: when it began, UTC.
        wall_s: how long it took (s).
        load_before, load_after: load average of 1, 5 and 15 minutes; ours is in the second.
    """

    tables: tuple[Table, ...]
    quick: bool
    date: str
    wall_s: float
    load_before: list[float] | None
    load_after: list[float] | None
    machine: dict[str, object]
    versions: dict[str, str]
    git_commit: str

    @property
    def unequal(self) -> list[str]:
        """Contenders that did not compute the same; their numbers mean nothing."""
        checks = [check for table in self.tables for check in table.checks]
        return [check.what for check in checks if not check.passed]

    def document(self) -> dict[str, Any]:
        """All of it as JSON; a difference that is not finite is null."""
        document = {"status": "failed" if self.unequal else "ok"} | asdict(self)
        for table, written in zip(self.tables, document["tables"], strict=True):
            for check, entry in zip(table.checks, written["checks"], strict=True):
                entry["passed"] = check.passed
                entry["error"] = check.error if math.isfinite(check.error) else None
        return document


def run_bench(
    sections: Sequence[str] = (),
    *,
    quick: bool = False,
    working: Callable[[str], AbstractContextManager[object]] | None = None,
) -> Benchmark:
    """Run sections of the benchmark, in the order of `SECTIONS`.

    Args:
        sections: names; none means all.
        quick: seconds instead of minutes, to see that it works.
        working: entered with the name of each section while it runs.

    Raises:
        BenchError: no such section.
    """
    for name in sections:
        if name not in SECTIONS:
            allowed = f"allowed: {', '.join(SECTIONS)}{did_you_mean(name, SECTIONS)}"
            raise BenchError(f"bench {show(name)}: no such section; {allowed}")
    load_before, began = load_average(), time.perf_counter()
    date, tables = datetime.now(UTC).isoformat(timespec="seconds"), []
    for name, bench in SECTIONS.items():
        if not sections or name in sections:
            if working is None:
                tables += bench(quick)
            else:
                with working(f"timing: {name}"):
                    tables += bench(quick)
    return Benchmark(
        tables=tuple(tables),
        quick=quick,
        date=date,
        wall_s=time.perf_counter() - began,
        load_before=load_before,
        load_after=load_average(),
        machine=machine(),
        versions=versions(),
        git_commit=git_commit(),
    )
