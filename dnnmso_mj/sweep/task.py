"""The unit of work of a sweep: a scenario, its model and some seeds in, one row a seed out.

Nothing here knows where it runs: all that a task needs travels inside it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.simulate import simulate
from dnnmso_mj.wording import clean

Row = dict[str, Any]


@dataclass(frozen=True)
class Task:
    """Some runs of one grid point.

    Args:
        point: the number of the grid point.
        scenario: the resolved scenario, whatever its seed.
        mjcf: the model's text; only mesh files, if it has any, are read from its folder.
        seeds: one run each.
    """

    point: int
    scenario: Scenario
    mjcf: Mjcf
    seeds: tuple[int, ...]


def run_task(task: Task) -> Iterator[Row]:
    """Run a task's seeds in turn, and yield each row as it is finished.

    A run that diverges or raises is a row like any other, with its status and reason.
    """
    for seed in task.seeds:
        started = time.perf_counter()
        try:
            scenario = task.scenario.model_copy(update={"seed": seed})
            trace = simulate(scenario, task.mjcf, watch=False)  # no metric is of the monitors
            row = {
                "point": task.point,
                "seed": seed,
                "status": trace.info.status,
                "reason": trace.info.reason,
                **compute_metrics(trace),
                "ticks": len(trace),
            }
        except Exception as error:
            row = failed_row(task.point, seed, f"{type(error).__name__}: {error}")
        yield row | {"wall_s": time.perf_counter() - started}


def failed_row(point: int, seed: int, reason: str) -> Row:
    """The row of a run that has no trace, and so no metrics."""
    return {"point": point, "seed": seed, "status": "failed", "reason": clean(reason), "ticks": 0}
