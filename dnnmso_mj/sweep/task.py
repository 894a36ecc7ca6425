"""The unit of work of a sweep: a scenario, its model and some seeds in, one row a seed out.

Nothing here knows where it runs: all that a task needs travels inside it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import Field, dataclass
from typing import Any, ClassVar, Protocol

from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.simulation import simulate
from dnnmso_mj.wording import clean

Row = dict[str, Any]


class Work(Protocol):
    """What a worker process can be given: a picklable dataclass whose call yields one row a seed.

    A row names its point and seed; those of runs whose process died are `failed_row`'s.
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    @property
    def point(self) -> int:
        """What the runs are of; with the seed it names a run."""

    @property
    def seeds(self) -> tuple[int, ...]:
        """In the order of the rows."""

    def __call__(self) -> Iterator[Row]:
        """Make the runs, in a process that has nothing but this."""


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

    def __call__(self) -> Iterator[Row]:
        """See `run_task`."""
        return run_task(self)


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
