"""What a comparison says: each controller's figures, its failures, and who beats whom."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from dnnmso_mj.comparison.pairing import Pairing, corrected, pair
from dnnmso_mj.comparison.plan import COLUMN, ComparisonError
from dnnmso_mj.sweep.statistics import Spread, spread
from dnnmso_mj.sweep.summary import Failure

Array = np.ndarray

RANKED_BY = "rmse_steady"
# Where a run that did not end well is worse than all others; what it did before says nothing.
JUDGED = (RANKED_BY, "tau_peak", "tau_chatter")
MEASURED = ("compute_us_p50",)  # of every run that has it


@dataclass(frozen=True)
class Standing:
    """One controller over its seeds.

    Args:
        controller: its name.
        runs: how many there are, however they ended.
        metrics: name -> spread; of those in `JUDGED` over all runs, inf for each that failed.
        failures: every run that diverged, or raised.
    """

    controller: str
    runs: int
    metrics: Mapping[str, Spread]
    failures: Sequence[Failure]

    def count(self, status: str) -> int:
        """How many runs failed in this way: "diverged" or "failed"."""
        return sum(failure.status == status for failure in self.failures)


@dataclass(frozen=True)
class Comparison:
    """All of them.

    Args:
        standings: the best first, by the median of `RANKED_BY`, then by failures.
        pairings: each but the first that was asked for against that first, in the order asked for.
    """

    standings: Sequence[Standing]
    pairings: Sequence[Pairing]


def summarise(table: pa.Table) -> Comparison:
    """What the finished table of a comparison says.

    Args:
        table: rows by controller, in the order asked for, then seed.

    Raises:
        ComparisonError: no table of a comparison.
    """
    if COLUMN not in table.column_names:
        raise ComparisonError(f"the table has no column {COLUMN}; allowed: one of dnnmso compare")
    names = table[COLUMN].unique().to_pylist()
    parts = {name: table.filter(pc.equal(table[COLUMN], name)) for name in names}
    standings = [_standing(name, rows) for name, rows in parts.items()]
    first, *others = names
    values = {name: judged(rows, RANKED_BY) for name, rows in parts.items()}
    pairings = [pair(name, first, values[name], values[first]) for name in others]
    standings.sort(key=_rank)
    return Comparison(standings, corrected(pairings))


def judged(rows: pa.Table, metric: str) -> Array:
    """A metric of every run, shape (n,): inf where the run did not end well or has no value."""
    is_ok = pc.equal(rows["status"], "ok")
    values = pc.if_else(is_ok, rows[metric], pa.scalar(None, rows[metric].type))
    return np.asarray(pc.fill_null(values, np.inf), dtype=float)


def _standing(name: str, rows: pa.Table) -> Standing:
    bad = rows.filter(pc.not_equal(rows["status"], "ok")).select(["seed", "status", "reason"])
    metrics = {metric: spread(judged(rows, metric)) for metric in JUDGED}
    for metric in MEASURED:
        metrics[metric] = spread(np.asarray(rows[metric].drop_null(), dtype=float))
    failures = [Failure({COLUMN: name}, **row) for row in bad.to_pylist()]
    return Standing(name, len(rows), metrics, failures)


def _rank(standing: Standing) -> tuple[float, int]:
    median = standing.metrics[RANKED_BY].median
    return (np.inf if median is None else median, len(standing.failures))
