"""Every metric against a trace whose answer is known in closed form."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from trace_samples import DT, METRICS, trace_with

from dnnmso_mj import metrics as metrics_module
from dnnmso_mj.metrics import bound_violations, compute_metrics, settling_time
from dnnmso_mj.trace import StepLayout, Trace


def trace_of(n_ticks: int, status: str = "ok", n_joints: int = 2, **columns: Any) -> Trace:
    """A trace of zeros, but for the bound (undefined) and the columns given (broadcast)."""
    layout = StepLayout(n_joints, 3)
    rows = np.zeros((n_ticks, layout.width))
    return trace_with(rows, layout, {"ultimate_bound": -1.0} | columns, status=status)


def halves(first: float, second: float, n_ticks: int = 1001) -> np.ndarray:
    """A column that steps from one value to another at tick N//2."""
    return np.where(np.arange(n_ticks) < n_ticks // 2, first, second)


def test_names_are_the_contract() -> None:
    assert set(compute_metrics(trace_of(10))) == METRICS


def test_rmse_of_a_constant_error_is_its_size_whatever_its_sign() -> None:
    metrics = compute_metrics(trace_of(101, q=[0.0, 1.0], q_ref=[0.3, 0.7]))
    assert metrics["rmse"] == pytest.approx(0.3, rel=1e-14)


def test_rmse_averages_squares_over_ticks_and_joints() -> None:
    metrics = compute_metrics(trace_of(100, q=[3.0, 4.0]))
    assert metrics["rmse"] == pytest.approx(math.sqrt(12.5), rel=1e-14)


def test_rmse_of_a_sine_is_amplitude_over_root_two() -> None:
    phase = 2 * np.pi * np.arange(1000) / 250
    metrics = compute_metrics(trace_of(1000, q=0.2 * np.sin(phase)))
    assert metrics["rmse"] == pytest.approx(0.2 / math.sqrt(2), rel=1e-12)
    assert metrics["rmse_steady"] == pytest.approx(0.2 / math.sqrt(2), rel=1e-12)


def test_rmse_steady_takes_the_ticks_from_n_over_two() -> None:
    metrics = compute_metrics(trace_of(1001, q=halves(5.0, 0.25)))
    assert metrics["rmse_steady"] == pytest.approx(0.25, rel=1e-14)
    whole = math.sqrt((500 * 25 + 501 * 0.0625) / 1001)
    assert metrics["rmse"] == pytest.approx(whole, rel=1e-14)


def test_max_abs_error_steady_sees_one_negative_tick_of_the_last_half_only() -> None:
    q = np.zeros((1001, 2))
    q[499] = 9.0  # the last tick of the first half
    q[500, 1] = -0.7
    q[800, 0] = 0.6
    assert compute_metrics(trace_of(1001, q=q))["max_abs_error_steady"] == 0.7


def test_tau_peak_is_the_largest_magnitude_applied_not_asked_for() -> None:
    tau = np.zeros((100, 2))
    tau[3, 1], tau[60, 0] = -40.0, 30.0
    assert compute_metrics(trace_of(100, tau=tau, tau_cmd=1e3))["tau_peak"] == 40.0


def test_tau_chatter_of_an_alternating_torque_is_twice_its_amplitude() -> None:
    alternating = np.where(np.arange(1000) % 2, 1.5, -1.5)
    assert compute_metrics(trace_of(1000, tau=alternating))["tau_chatter"] == 3.0


def test_tau_chatter_averages_joints_and_leaves_out_the_first_half() -> None:
    tau = np.zeros((1000, 2))
    tau[:500] = np.where(np.arange(500) % 2, 100.0, -100.0)[:, None]
    tau[500:, 0] = 0.01 * np.arange(500)  # a ramp on one joint of two
    assert compute_metrics(trace_of(1000, tau=tau))["tau_chatter"] == pytest.approx(0.005)


def test_f_err_rms_steady_is_over_all_rows_of_the_last_half() -> None:
    f_true = np.zeros((1001, 4))
    f_true[:500] = 50.0
    f_true[500:] = [2.0, 0.0, 0.0, 4.0]
    metrics = compute_metrics(trace_of(1001, f_true=f_true, f_hat=[0.0, 0.0, 0.0, -2.0]))
    assert metrics["f_err_rms_steady"] == pytest.approx(math.sqrt((4 + 36) / 4), rel=1e-14)


def test_settling_time_of_a_decay_is_when_it_reaches_two_percent() -> None:
    t = DT * np.arange(10_000)
    trace = trace_of(10_000, q=np.stack([-np.exp(-t), 0 * t], axis=1))
    assert settling_time(trace) == pytest.approx(math.log(50), abs=DT)


def test_settling_time_is_of_the_slowest_joint() -> None:
    t = DT * np.arange(10_000)
    trace = trace_of(10_000, q=np.stack([np.exp(-4 * t), np.exp(-t)], axis=1))
    assert settling_time(trace) == pytest.approx(math.log(50), abs=DT)


def test_settling_time_counts_the_last_entry_into_the_band() -> None:
    error = np.zeros(1000)
    error[0], error[700] = 1.0, 0.021
    assert settling_time(trace_of(1000, q=error)) == pytest.approx(0.701)
    error[700] = 0.019
    assert settling_time(trace_of(1000, q=error)) == pytest.approx(0.001)


def test_settling_band_is_of_the_first_half() -> None:
    error = np.zeros(1000)
    error[:400], error[600], error[700] = 1.0, 100.0, 1.0
    assert settling_time(trace_of(1000, q=error)) == pytest.approx(0.701)


@pytest.mark.parametrize(
    "error",
    [
        np.full(1000, 0.1),
        np.linspace(1.0, 0.0, 1000),  # in the band, but for less than a tenth of the run
        np.where(np.arange(1000) == 999, 0.5, halves(1.0, 0.0, 1000)),
    ],
    ids=["constant", "crosses zero at the end", "leaves at the last tick"],
)
def test_an_error_that_does_not_stay_in_the_band_never_settles(error: np.ndarray) -> None:
    assert settling_time(trace_of(1000, q=error)) is None


def test_a_perfect_run_is_settled_from_its_start() -> None:
    assert settling_time(trace_of(1000)) == 0.0


def test_a_diverged_run_never_settles() -> None:
    trace = trace_of(1000, status="diverged", q=halves(1.0, 0.0, 1000))
    assert settling_time(trace) is None
    assert compute_metrics(trace)["diverged"] is True


@pytest.mark.parametrize("status", ["ok", "interrupted", "unfinished"])
def test_only_the_status_diverged_is_diverged(status: str) -> None:
    assert compute_metrics(trace_of(10, status=status))["diverged"] is False


def test_bound_violations_are_counted_against_the_bound_of_their_tick() -> None:
    bound = np.linspace(1.0, 0.1, 10)
    q = np.zeros((10, 2))
    q[:, 1] = -bound  # on the bound: none
    assert bound_violations(trace_of(10, q=q, ultimate_bound=bound)) == 0
    q[[2, 7], 1] *= 1.02  # past the margin of 1 %
    q[[3, 8], 1] *= 1.005  # within it
    assert bound_violations(trace_of(10, q=q, ultimate_bound=bound)) == 2


def test_rounding_on_a_zero_bound_is_no_violation() -> None:
    assert bound_violations(trace_of(10, q=0.9e-9, ultimate_bound=0.0)) == 0
    assert bound_violations(trace_of(10, q=1.1e-9, ultimate_bound=0.0)) == 10


def test_ticks_without_a_bound_are_not_violations_and_no_bound_at_all_is_none() -> None:
    bound = np.where(np.arange(10) < 4, -1.0, 0.5)
    assert bound_violations(trace_of(10, q=1.0, ultimate_bound=bound)) == 6
    assert bound_violations(trace_of(10, q=1.0, ultimate_bound=-1.0)) is None


def test_compute_percentiles_are_of_the_whole_run() -> None:
    metrics = compute_metrics(trace_of(1001, compute_us=np.arange(1001.0)[::-1]))
    assert metrics["compute_us_p50"] == pytest.approx(500.0)
    assert metrics["compute_us_p999"] == pytest.approx(999.0)


def test_deadline_misses_are_counted_over_the_whole_run() -> None:
    missed = np.zeros(100)
    missed[[0, 50, 99]] = 1.0
    assert compute_metrics(trace_of(100, deadline_missed=missed))["deadline_misses"] == 3


def test_an_empty_run_has_only_what_can_be_counted() -> None:
    metrics = compute_metrics(trace_of(0, status="diverged"))
    assert metrics.pop("diverged") is True
    assert metrics.pop("deadline_misses") == 0
    assert set(metrics.values()) == {None}


def test_a_single_tick_has_no_chatter() -> None:
    metrics = compute_metrics(trace_of(1, q=0.5, tau=3.0))
    assert metrics["tau_chatter"] is None
    assert metrics["rmse"] == metrics["rmse_steady"] == 0.5
    assert metrics["tau_peak"] == 3.0


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_column_that_is_not_finite_has_no_metric_and_json_stays_valid(bad: float) -> None:
    q, tau = np.ones((10, 2)), np.ones((10, 2))
    q[9, 0] = tau[9, 0] = bad
    trace = trace_of(10, status="diverged", q=q, tau=tau, f_true=bad, ultimate_bound=2.0)
    metrics = compute_metrics(trace)
    json.dumps(metrics, allow_nan=False)
    assert metrics["rmse"] is metrics["tau_peak"] is metrics["tau_chatter"] is None
    assert metrics["f_err_rms_steady"] is None
    assert metrics["bound_violations"] == 1


def test_a_huge_error_does_not_overflow() -> None:
    assert compute_metrics(trace_of(10, q=1e200))["rmse"] == pytest.approx(1e200)


errors = hnp.arrays(float, st.tuples(st.integers(2, 40), st.just(3)), elements=st.floats(-10, 10))
relaxed = settings(max_examples=50, deadline=None)


@relaxed
@given(errors, st.permutations(range(3)))
def test_the_order_of_the_joints_does_not_matter(error: np.ndarray, order: list[int]) -> None:
    ours, theirs = (
        compute_metrics(trace_of(len(e), n_joints=3, q=e, tau=e, ultimate_bound=3.0))
        for e in (error, error[:, order])
    )
    for name, value in ours.items():
        expected = value if value is None else pytest.approx(value, rel=1e-12)
        assert theirs[name] == expected, name


@relaxed
@given(errors, st.floats(0.1, 10.0))
def test_errors_scale_with_their_unit_and_settling_does_not(
    error: np.ndarray, factor: float
) -> None:
    n_ticks = len(error)
    once = compute_metrics(trace_of(n_ticks, n_joints=3, q_ref=error))
    scaled = compute_metrics(trace_of(n_ticks, n_joints=3, q=factor * error))
    for name in ("rmse", "rmse_steady", "max_abs_error_steady"):
        assert scaled[name] == pytest.approx(factor * (once[name] or 0.0), rel=1e-9, abs=1e-300)
    assert (once["rmse"] or 0.0) <= np.abs(error).max() * (1 + 1e-12)


@relaxed
@given(errors)
def test_every_metric_is_finite_or_none_and_survives_json(error: np.ndarray) -> None:
    trace = trace_of(len(error), n_joints=3, q=error, tau=error, compute_us=error[:, 0])
    metrics = compute_metrics(trace)
    assert json.loads(json.dumps(metrics, allow_nan=False)) == metrics


def test_blocks_change_a_metric_by_its_rounding_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    columns = {name: rng.normal(size=(500, 2)) for name in ("q", "q_ref", "tau")}
    columns["q"] *= np.exp(-np.arange(500) / 50)[:, None]
    columns["q_ref"][:] = 0.0
    columns |= {"f_true": rng.normal(size=(500, 4)), "compute_us": rng.exponential(size=500)}
    columns["deadline_missed"] = rng.random(500) < 0.1
    trace = trace_of(500, ultimate_bound=0.1, **columns)
    whole = compute_metrics(trace)
    assert None not in whole.values()
    for ticks in (1, 2, 63, 249, 250, 251, 499, 500):
        monkeypatch.setattr(metrics_module, "BLOCK", ticks)
        for name, value in compute_metrics(trace).items():
            assert value == pytest.approx(whole[name], rel=1e-13), (ticks, name)
