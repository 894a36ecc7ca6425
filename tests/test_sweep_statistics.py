"""Median, quartiles and the bootstrap interval, held against what is known of them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from dnnmso_mj.sweep.statistics import FEWEST_FOR_INTERVAL, MOST_TO_RESAMPLE, spread


def test_median_and_quartiles_of_a_known_sample():
    found = spread(np.arange(1.0, 102.0))
    assert (found.n, found.median, found.q25, found.q75) == (101, 51.0, 26.0, 76.0)


def test_the_interval_is_near_the_exact_one_of_order_statistics():
    values = np.random.default_rng(1).normal(size=1001)
    found = spread(values)
    # Of the median of n values: ranks n/2 ± 1.96 √n/2.
    low, high = stats.binom.interval(0.95, 1001, 0.5)
    exact = np.sort(values)[[int(low), int(high)]]
    width = exact[1] - exact[0]
    assert found.ci_low == pytest.approx(exact[0], abs=0.15 * width)
    assert found.ci_high == pytest.approx(exact[1], abs=0.15 * width)


def test_the_interval_of_many_values_is_the_narrowest_exact_one():
    n = MOST_TO_RESAMPLE + 1
    found = spread(np.random.default_rng(6).permutation(n).astype(float))  # value k has rank k + 1
    assert found.ci_method == "order statistics"
    low, high = int(found.ci_low) + 1, int(found.ci_high) + 1

    def held(low: int, high: int) -> float:
        return stats.binom.cdf(high - 1, n, 0.5) - stats.binom.cdf(low - 1, n, 0.5)

    assert low + high == n + 1
    assert held(low, high) >= 0.95 > held(low + 1, high - 1)


def test_both_intervals_agree_where_one_takes_over_from_the_other():
    values = np.random.default_rng(7).normal(size=MOST_TO_RESAMPLE + 1)
    fewer, more = spread(values[:-1]), spread(values)
    assert (fewer.ci_method, more.ci_method) == ("bootstrap", "order statistics")
    width = more.ci_high - more.ci_low
    assert fewer.ci_low == pytest.approx(more.ci_low, abs=0.15 * width)
    assert fewer.ci_high == pytest.approx(more.ci_high, abs=0.15 * width)


def test_the_interval_holds_the_true_median_about_as_often_as_it_says():
    rng = np.random.default_rng(2)
    samples = [spread(rng.exponential(size=30), seed=k) for k in range(300)]
    true = np.log(2.0)
    share = np.mean([found.ci_low <= true <= found.ci_high for found in samples])
    assert 0.90 <= share <= 0.99


def test_same_values_give_the_same_interval_and_outliers_hardly_move_it():
    values = np.random.default_rng(3).normal(size=200)
    assert spread(values) == spread(values.copy())
    wild = values.copy()
    wild[np.argmax(values)] = 1e300
    assert spread(wild).ci_high == spread(values).ci_high
    assert spread(wild).q75 == spread(values).q75


def test_too_few_values_have_no_interval_and_none_have_nothing():
    few = spread(np.arange(FEWEST_FOR_INTERVAL - 1, dtype=float))
    assert few.median == 2.0
    assert few.ci_low is few.ci_high is few.ci_method is None
    enough = spread(np.arange(FEWEST_FOR_INTERVAL, dtype=float))
    assert enough.ci_low < enough.median < enough.ci_high
    nothing = spread(np.empty(0))
    assert nothing.n == 0
    assert nothing.median is None


def test_equal_values_have_an_interval_of_no_width():
    assert spread(np.full(50, 3.0)).ci_low == spread(np.full(50, 3.0)).ci_high == 3.0
