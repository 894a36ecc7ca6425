"""Many runs at once: the package's sweep against a process pool of the loop in PyTorch."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from contextlib import closing
from functools import partial

import numpy as np

from dnnmso_mj.bench.tick import paper
from dnnmso_mj.bench.timing import Contender, Probe, Row, Table, race
from dnnmso_mj.sweep.plan import plan_sweep
from dnnmso_mj.sweep.run import make_engine

Array = np.ndarray
Runs = Callable[[int, int], Generator[int]]  # ticks a run, workers -> ticks of each finished run

PLENTY = 100_000  # seeds; the sweep is stopped when it has been timed
PLENTY_A_WORKER = 500  # for the pool, which takes in all its tasks at once


def bench_sweep(quick: bool) -> list[Table]:
    """Closed-loop learning ticks a second, on one core and on all."""
    ticks, seconds, rounds = (100, 0.2, 1) if quick else (1000, 3.0, 5)
    contenders = _contenders(ticks, seconds, (1, make_engine().jobs))
    rows = race(contenders, rounds, more_is_better=True, warm=False)
    return [
        Table(
            name="sweep",
            title=f"Sweep over seeds of the initial weights, {ticks} ticks a run",
            work="the paper's closed loop, workers warm; ours computes metrics of each run too",
            unit="ticks/s",
            rows=rows,
            details=_scaling(rows),
        )
    ]


def _contenders(ticks: int, seconds: float, jobs: tuple[int, ...]) -> list[Contender]:
    contenders = []
    for count in dict.fromkeys(jobs):
        workers = f"{count} worker{'s' if count > 1 else ''}"
        ours, theirs = f"dnnmso sweep, {workers}", f"pool of PyTorch loops, {workers}"
        our_make = partial(_probe, _our_runs, ticks, count, seconds)
        their_make = partial(_pool, ticks, count, seconds)
        contenders += [
            Contender(ours, "cores: the loop as in `tick`", our_make, ours),
            Contender(theirs, "cores: the interpreter in each", their_make, ours),
        ]
    return contenders


def _scaling(rows: tuple[Row, ...]) -> dict[str, float]:
    """How many times faster all cores are than one, of each kind."""
    scaling = {}
    for one, many in zip(rows[:2], rows[2:], strict=False):
        if one.median and many.median:
            scaling[f"{many.name} against 1"] = many.median / one.median
    return scaling


def _our_runs(ticks: int, jobs: int) -> Generator[int]:
    plan = plan_sweep("paper", range(PLENTY), [f"duration={ticks * 1e-3}"])
    with closing(make_engine(jobs=jobs).rows(plan.tasks([set()]))) as rows:
        for row in rows:
            yield row["ticks"]


def _torch_runs(ticks: int, jobs: int) -> Generator[int]:
    from dnnmso_mj.bench.torch_loop import pool_of_loops

    with closing(pool_of_loops(paper(ticks), jobs, range(PLENTY_A_WORKER * jobs))) as runs:
        yield from runs


def _pool(ticks: int, jobs: int, seconds: float) -> Probe:
    import torch  # noqa: F401  # now, so that a missing torch is told of

    return _probe(_torch_runs, ticks, jobs, seconds)


def _probe(runs: Runs, ticks: int, jobs: int, seconds: float) -> Probe:
    """Ticks a second between two finished runs, from when every worker has finished some."""

    def probe() -> Array:
        with closing(runs(ticks, jobs)) as finished:
            for _ in range(2 * jobs):
                next(finished)
            began = last = time.perf_counter()
            done = 0
            while last - began < seconds:
                done += next(finished)
                last = time.perf_counter()
        return np.array([done / (last - began)])

    return probe
