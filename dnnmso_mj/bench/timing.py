"""Contenders timed in turn, round after round, and what is told of them.

A ratio is taken within each round, between contenders that ran within the same second, and its
median over the rounds is told; no best-of-N.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

Array = np.ndarray
Probe = Callable[[], Array]
"""One round of one contender: its samples (m,), in the unit of the table."""

ENOUGH_FOR_TAIL = 1000  # samples, below which a 99.9th percentile is only the maximum


@dataclass(frozen=True)
class Contender:
    """Someone who does the work.

    Args:
        name: as the table has it.
        bounded_by: what limits it, in a few words.
        make: prepares it; an ImportError makes the row say what is missing.
        versus: name of the contender that its ratio is taken to; "" for the first one.
        curve, at: where it belongs in a picture of growth: which curve, and where along the axis.
    """

    name: str
    bounded_by: str
    make: Callable[[], Probe]
    versus: str = ""
    curve: str = ""
    at: float | None = None


@dataclass(frozen=True)
class Row:
    """What a table tells of one contender; None where there is nothing to tell.

    Args:
        median: over all samples.
        low, high: smallest and largest median of a round.
        p99, p999, max: over all samples; only with `ENOUGH_FOR_TAIL` of them.
        ratio: how many times slower it is than `versus`.
        missing: what is not installed, and how to get it.
        curve, at: as of the contender.
    """

    name: str
    bounded_by: str
    median: float | None = None
    low: float | None = None
    high: float | None = None
    p99: float | None = None
    p999: float | None = None
    max: float | None = None
    ratio: float | None = None
    versus: str = ""
    samples: int = 0
    missing: str = ""
    curve: str = ""
    at: float | None = None


@dataclass(frozen=True)
class Check:
    """Proof that contenders compute the same: a difference and what rounding allows."""

    what: str
    error: float
    tolerance: float

    @property
    def passed(self) -> bool:
        """Whether they do."""
        return self.error <= self.tolerance


@dataclass(frozen=True)
class Table:
    """One comparison.

    Args:
        work: what every contender does, in a sentence.
        unit: of all numbers but the ratios; "ticks/s" is better when larger.
        checks: that they do.
        details: what else was measured or follows.
        axis: what grows, where the rows are points of curves.
    """

    name: str
    title: str
    work: str
    unit: str
    rows: tuple[Row, ...]
    checks: tuple[Check, ...] = ()
    details: dict[str, float] = field(default_factory=dict)
    axis: str = ""


def timed(step: Callable[[], object], calls: int) -> Probe:
    """A probe that times `calls` single calls (µs)."""

    def probe() -> Array:
        samples, clock = np.empty(calls), time.perf_counter_ns
        for k in range(calls):
            began = clock()
            step()
            samples[k] = clock() - began
        return samples * 1e-3

    return probe


def race(
    contenders: Sequence[Contender], rounds: int, *, more_is_better: bool = False, warm: bool = True
) -> tuple[Row, ...]:
    """Time contenders A B C, A B C, … and tell of each.

    Args:
        contenders: the first is the one that ratios are taken to, unless `versus` says otherwise.
        rounds: how often each has its turn.
        more_is_better: the samples are rates, not times.
        warm: whether each has one turn first that does not count.
    """
    probes: dict[str, Probe] = {}
    missing: dict[str, str] = {}
    for contender in contenders:
        try:
            probes[contender.name] = contender.make()
        except ImportError as error:
            missing[contender.name] = f"{error}; pip install 'dnnmso_mj[bench]'"
    if warm:
        for probe in probes.values():
            probe()
    samples: dict[str, list[Array]] = {name: [] for name in probes}
    with _no_garbage_collection():
        for _ in range(rounds):
            for name, probe in probes.items():
                samples[name].append(probe())
            gc.collect()
    first = contenders[0].name
    return tuple(
        _row(c, samples, c.versus or first, missing.get(c.name, ""), more_is_better)
        for c in contenders
    )


@contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Inside, Python collects only when told to, and then only what was made inside."""
    collecting = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.unfreeze()
        if collecting:
            gc.enable()


def _row(
    contender: Contender,
    samples: dict[str, list[Array]],
    versus: str,
    missing: str,
    more_is_better: bool,
) -> Row:
    if missing:
        return Row(
            contender.name,
            contender.bounded_by,
            missing=missing,
            curve=contender.curve,
            at=contender.at,
        )
    rounds = np.array([np.median(part) for part in samples[contender.name]])
    pooled = np.concatenate(samples[contender.name])
    tail = pooled.size >= ENOUGH_FOR_TAIL
    ratio = None
    if versus in samples and versus != contender.name:
        theirs = np.array([np.median(part) for part in samples[versus]])
        times = theirs / rounds if more_is_better else rounds / theirs
        ratio = float(np.median(times))
    return Row(
        contender.name,
        contender.bounded_by,
        median=float(np.median(pooled)),
        low=float(rounds.min()),
        high=float(rounds.max()),
        p99=float(np.percentile(pooled, 99)) if tail else None,
        p999=float(np.percentile(pooled, 99.9)) if tail else None,
        max=float(pooled.max()) if tail else None,
        ratio=ratio,
        versus=versus if ratio is not None else "",
        samples=int(pooled.size),
        curve=contender.curve,
        at=contender.at,
    )
