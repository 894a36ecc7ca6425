"""What tuning minimises: the error, made dear by chatter, with every lost run worse than any kept.

The error alone would reward gains so high that the torque chatters.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from dnnmso_mj.sweep.task import Row
from dnnmso_mj.tuning import TuneError

# Above every value that a run which is kept can have; each tier above all of the one before.
OVER_LIMIT = 1e6
LOST = 1e9


@dataclass(frozen=True)
class Objective:
    """A number for the runs of one trial; smaller is better.

    Where every run ends well and keeps the limits, with c₀ = `chatter_scale`:

        median over seeds of  rmse_steady √(1 + (tau_chatter / c₀)²)      (rad)

    Where the worst run is over a limit: 1e6 (1 + its largest excess / that limit). Where runs
    diverge or fail: 1e9 (1 + mean over seeds of the part of the run that was lost). So trials
    without a good run are ordered too, by how near to one they come.

    Args:
        chatter_scale: at this chatter the error counts √2 times (N·m a step).
        max_peak: of tau_peak, over all seeds (N·m); None: any.
        max_chatter: of tau_chatter, over all seeds (N·m a step); None: any.

    Raises:
        TuneError: a scale or a limit that is not positive.
    """

    chatter_scale: float = 0.05
    max_peak: float | None = None
    max_chatter: float | None = None

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is not None and not 0 < value < math.inf:
                option = name.replace("_", "-")
                raise TuneError(f"--{option} {value:g}: allowed: a finite number > 0")

    @property
    def words(self) -> str:
        """It all on one line, for records."""
        limits = [
            f"{name} <= {limit:g} {unit}"
            for name, limit, unit in (
                ("tau_peak", self.max_peak, "N·m"),
                ("tau_chatter", self.max_chatter, "N·m a step"),
            )
            if limit is not None
        ]
        formula = f"rmse_steady sqrt(1 + (tau_chatter / {self.chatter_scale:g} N·m a step)^2)"
        where = f"; {' and '.join(limits)} in every run" if limits else ""
        return f"median over seeds of {formula}{where}; {LOST:g} and more with a lost run"

    def value(self, rows: Sequence[Row], n_ticks: int) -> float:
        """Of one trial.

        Args:
            rows: one for each seed.
            n_ticks: of a whole run.

        Raises:
            TuneError: a run is too short to have the metrics.
        """
        lost = [0.0 if row["status"] == "ok" else 1.0 - row["ticks"] / n_ticks for row in rows]
        if any(row["status"] != "ok" for row in rows):
            return LOST * (1.0 + statistics.fmean(lost))
        excess = max(
            _excess(rows, "tau_peak", self.max_peak),
            _excess(rows, "tau_chatter", self.max_chatter),
        )
        if excess > 0.0:
            return min(OVER_LIMIT * (1.0 + excess), LOST)
        return min(statistics.median(map(self._cost, rows)), OVER_LIMIT)

    def _cost(self, row: Row) -> float:
        chatter = _metric(row, "tau_chatter") / self.chatter_scale
        return _metric(row, "rmse_steady") * math.hypot(1.0, chatter)


def _excess(rows: Sequence[Row], name: str, limit: float | None) -> float:
    """How far the worst run is over a limit, in parts of it; not positive within it."""
    return 0.0 if limit is None else max(_metric(row, name) for row in rows) / limit - 1.0


def _metric(row: Row, name: str) -> float:
    value = row[name]
    if value is None:
        allowed = "allowed: a longer scenario.duration"
        raise TuneError(f"seed {row['seed']}: has no {name}; {allowed}")
    return float(value)
