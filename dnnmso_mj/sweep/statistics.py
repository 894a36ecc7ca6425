"""What can be said of a metric over seeds: median, quartiles, and how sure the median is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import stats

Array = np.ndarray

QUARTILES = (25.0, 50.0, 75.0)
CONFIDENCE = 0.95
# Median and extremes of n values: the true median is between them with probability 1 - 2^(1-n),
# so with fewer no interval between values that were seen holds 95 %.
FEWEST_FOR_INTERVAL = 6
MOST_TO_RESAMPLE = 10_000  # values; beyond, the exact interval is as narrow and takes no time
RESAMPLES = 1999
BATCH = 4_000_000  # numbers that are resampled at once


@dataclass(frozen=True)
class Spread:
    """Of n values: median, quartiles, and the 95 % interval of the median; None: too few.

    Args:
        ci_method: "bootstrap" or "order statistics".
    """

    n: int
    median: float | None
    q25: float | None
    q75: float | None
    ci_low: float | None
    ci_high: float | None
    ci_method: str | None


def spread(values: Array, seed: int = 0) -> Spread:
    """Describe values (n,) by what outliers cannot move.

    The interval is the percentile bootstrap's, over `RESAMPLES` resamples; of more than
    `MOST_TO_RESAMPLE` values, or where some are infinite, the exact one between two order
    statistics: the number of values under the true median is binomial (n, 1/2).

    Args:
        values: shape (n,), in an order that does not depend on how they were made; ±inf is a value
            beyond all others, and the middle of -inf and inf is 0.
        seed: of the resampling, so that the same values give the same interval.
    """
    n = len(values)
    if n == 0:
        return Spread(0, None, None, None, None, None, None)
    low, middle, high = _quartiles(values)
    if n < FEWEST_FOR_INTERVAL:
        return Spread(n, middle, low, high, None, None, None)
    if n > MOST_TO_RESAMPLE or not np.isfinite(values).all():
        return Spread(n, middle, low, high, *_order_statistics(values), "order statistics")
    return Spread(n, middle, low, high, *_bootstrap(values, seed), "bootstrap")


def _quartiles(values: Array) -> list[float]:
    if np.isfinite(values).all():
        found: list[float] = np.percentile(values, QUARTILES).tolist()
        return found
    ordered = np.sort(values)
    return [_between(ordered, percent) for percent in QUARTILES]


def _between(ordered: Array, percent: float) -> float:
    """A percentile of sorted values, some of them infinite, between the two that are nearest."""
    place = (len(ordered) - 1) * percent / 100.0
    low, high = float(ordered[math.floor(place)]), float(ordered[math.ceil(place)])
    if low == high:
        return low
    if math.isinf(low) and math.isinf(high):
        return 0.0
    weight = place - math.floor(place)
    return (1.0 - weight) * low + weight * high


def _order_statistics(values: Array) -> tuple[float, float]:
    # The median is above the k-th smallest and below the k-th largest of n values with probability
    # P(k <= B <= n - k), where B, binomial (n, 1/2), counts the values under it.
    n = len(values)
    k = int(stats.binom.ppf((1.0 - CONFIDENCE) / 2.0, n, 0.5))
    low, high = np.partition(values, [k - 1, n - k])[[k - 1, n - k]].tolist()
    return low, high


def _bootstrap(values: Array, seed: int) -> tuple[float, float]:
    n = len(values)
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
