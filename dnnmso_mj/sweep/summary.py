"""What a sweep says: every point's metrics over the runs that ended well, and who did not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from dnnmso_mj.sweep.plan import Plan
from dnnmso_mj.sweep.statistics import Spread, spread
from dnnmso_mj.sweep.table import METRIC_TYPES


@dataclass(frozen=True)
class Failure:
    """A run that has no say in the statistics."""

    parameters: Mapping[str, Any]
    seed: int
    status: str
    reason: str


@dataclass(frozen=True)
class PointSummary:
    """One grid point over its seeds.

    Args:
        parameters: key path -> value.
        runs: how many there are, however they ended.
        ok: how many ended well: all that `metrics` speaks of.
        metrics: name -> spread over the runs that have a value; its n says how many.
        failures: every other run.
    """

    parameters: Mapping[str, Any]
    runs: int
    ok: int
    metrics: Mapping[str, Spread]
    failures: Sequence[Failure]

    def count(self, status: str) -> int:
        """How many runs failed in this way: "diverged" or "failed"."""
        return sum(failure.status == status for failure in self.failures)


def summarise(table: pa.Table, plan: Plan) -> list[PointSummary]:
    """The finished table of a plan, point by point.

    Rows of runs that diverged or failed are counted and listed, never averaged: what they have of
    metrics speaks of the part that was run. No seed is left out for any other reason.
    """
    size = len(plan.seeds)
    return [
        summarise_rows(table.slice(k * size, size), point.parameters)
        for k, point in enumerate(plan.points)
    ]


def summarise_rows(rows: pa.Table, parameters: Mapping[str, Any]) -> PointSummary:
    """Some runs of a table, all with these parameters, as one point."""
    is_ok = pc.equal(rows["status"], "ok")
    good = rows.filter(is_ok)
    bad = rows.filter(pc.invert(is_ok)).select(["seed", "status", "reason"])
    metrics = {
        name: spread(np.asarray(good[name].drop_null(), dtype=float))
        for name, kind in METRIC_TYPES.items()
        if not pa.types.is_boolean(kind)
    }
    failures = [Failure(parameters, **row) for row in bad.to_pylist()]
    return PointSummary(parameters, len(rows), len(good), metrics, failures)
