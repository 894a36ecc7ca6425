"""The largest level that stands: bracketed by doubling, then bisected on a logarithmic scale."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

PRECISION = 0.05  # of the margin: what fails is at most this much above what stands
HALVINGS = 6  # below the start, before the margin is called smaller than anything probed
PROBES_BELOW = (0.25, 0.5, 0.75)  # of the margin, where a monotone controller stands

Status = Literal["found", "capped", "below", "none"]


@dataclass(frozen=True)
class Found:
    """What a search ended with.

    Args:
        status: found; capped: stands at the cap; below: fails at the smallest level probed; none:
            fails at level 0.
        margin: the largest level known to stand; 0 where the status is below or none.
        fails_at: the smallest level known to fail; None where capped.
        non_monotone: how many of the probes below the margin failed.
        runs: how many levels were probed.
    """

    status: Status
    margin: float
    fails_at: float | None
    non_monotone: int
    runs: int


def find_margin(
    stands: Callable[[float], bool], start: float, cap: float, precision: float = PRECISION
) -> Found:
    """Search the largest level at which `stands` holds, as if it held for all below.

    That it does is an assumption: it is tried at `PROBES_BELOW`, and exceptions are counted.

    Args:
        stands: level -> whether the controller stands it.
        start: the first level after 0, > 0.
        cap: the last one, >= start.
        precision: fails_at/margin - 1 at the most, where the status is found.
    """
    runs = 0

    def probe(level: float) -> bool:
        nonlocal runs
        runs += 1
        return stands(level)

    if not probe(0.0):
        return Found("none", 0.0, 0.0, 0, runs)
    low, high = _bracket(probe, start, cap)
    if low == 0.0:
        return Found("below", 0.0, high, 0, runs)
    while high is not None and high > low * (1.0 + precision):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if probe(middle) else (low, middle)
    non_monotone = sum(not probe(part * low) for part in PROBES_BELOW)
    return Found("capped" if high is None else "found", low, high, non_monotone, runs)


def _bracket(
    probe: Callable[[float], bool], start: float, cap: float
) -> tuple[float, float | None]:
    """A level that stands (0: none was found) and one at most twice as large that fails."""
    if probe(start):
        low = start
        while low < cap:
            high = min(2.0 * low, cap)
            if not probe(high):
                return low, high
            low = high
        return low, None
    high = start
    for _ in range(HALVINGS):
        low = high / 2.0
        if probe(low):
            return low, high
        high = low
    return 0.0, high
