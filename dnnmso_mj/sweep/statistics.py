"""What can be said of a metric over seeds: median, quartiles, and how sure the median is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

Array = np.ndarray

CONFIDENCE = 0.95
# Median and extremes of n values: the true median is between them with probability 1 - 2^(1-n),
# so with fewer no interval between values that were seen holds 95 %.
FEWEST_FOR_INTERVAL = 6
RESAMPLES = 1999
BATCH = 4_000_000  # numbers that are resampled at once


@dataclass(frozen=True)
class Spread:
    """Of n values: median, quartiles, and the 95 % interval of the median; None: too few."""

    n: int
    median: float | None
    q25: float | None
    q75: float | None
    ci_low: float | None
    ci_high: float | None


def spread(values: Array, seed: int = 0) -> Spread:
    """Describe finite values (n,) by what outliers cannot move.

    The interval is the percentile bootstrap's, over `RESAMPLES` resamples.

    Args:
        values: shape (n,), in an order that does not depend on how they were made.
        seed: of the resampling, so that the same values give the same interval.
    """
    n = len(values)
    if n == 0:
        return Spread(0, None, None, None, None, None)
    low, middle, high = np.percentile(values, [25.0, 50.0, 75.0]).tolist()
    ci_low, ci_high = _interval(values, seed)
    return Spread(n, middle, low, high, ci_low, ci_high)


def _interval(values: Array, seed: int) -> tuple[float | None, float | None]:
    n = len(values)
    if n < FEWEST_FOR_INTERVAL:
        return None, None
    if values.min() == values.max():
        return float(values[0]), float(values[0])
    found = stats.bootstrap(
        (values,),
        np.median,
        vectorized=True,
        method="percentile",
        n_resamples=RESAMPLES,
        batch=max(1, BATCH // n),
        confidence_level=CONFIDENCE,
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return float(found.low), float(found.high)
