"""How a run kept time: pure functions of its trace."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dnnmso_mj.trace import Array, Trace

TIMED = ("t", "compute_us", "wake_late_us", "deadline_missed")  # what it takes of a trace
PERCENTILES = {"p50": 50.0, "p99": 99.0, "p999": 99.9, "max": 100.0}


@dataclass(frozen=True)
class Miss:
    """Ticks one after the other that had no command in time."""

    t: float  # s, of the first
    ticks: int
    cause: str  # "computing": the update took too long; "waking": the process was not run


@dataclass(frozen=True)
class Timing:
    """Computing apart from waking: the one is the controller's, the other the machine's."""

    compute_us: dict[str, float]  # over ticks with an update: p50, p99, p999, max
    wake_late_us: dict[str, float]  # over the same ticks
    misses: tuple[Miss, ...]

    def ticks_missed(self, cause: str) -> int:
        """How many ticks were missed for one cause."""
        return sum(miss.ticks for miss in self.misses if miss.cause == cause)


def timing(trace: Trace) -> Timing:
    """How a paced run kept its deadlines.

    A row of misses is caused by its first tick: by computing if that tick's update took longer than
    the tick had been woken late, else by waking.
    """
    updated = trace["compute_us"] > 0.0
    return Timing(
        compute_us=_percentiles(trace["compute_us"][updated]),
        wake_late_us=_percentiles(trace["wake_late_us"][updated]),
        misses=tuple(_misses(trace)),
    )


def _percentiles(values: Array) -> dict[str, float]:
    if values.size == 0:
        return dict.fromkeys(PERCENTILES, 0.0)
    found = np.percentile(values, list(PERCENTILES.values()))
    return dict(zip(PERCENTILES, found.tolist(), strict=True))


def _misses(trace: Trace) -> list[Miss]:
    missed = np.concatenate([[False], trace["deadline_missed"], [False]])
    edges = np.flatnonzero(missed[1:] != missed[:-1])
    out = []
    for first, after in zip(edges[::2], edges[1::2], strict=True):
        # The tick before ended in time, so a first tick without an update was woken too late.
        computing = trace["compute_us"][first] > trace["wake_late_us"][first]
        cause = "computing" if computing else "waking"
        out.append(Miss(float(trace["t"][first]), int(after - first), cause))
    return out
