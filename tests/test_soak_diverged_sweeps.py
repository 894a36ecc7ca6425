"""Row 2 of the scorecard in its short form, and what its checker must catch."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from soak.diverged_sweeps import check_row, check_tail, has_diverged
from soak.proof import prove
from trace_samples import METRICS

from dnnmso_mj.loading import load_scenario
from dnnmso_mj.metrics import WHOLE, compute_metrics
from dnnmso_mj.simulation import simulate
from dnnmso_mj.trace import Trace


def test_diverged_sweeps(tmp_path: Path) -> None:
    prove(2, tmp_path)


@pytest.fixture(scope="module")
def lost() -> Trace:
    """A run that diverges: an observer with the printed sign."""
    trace = simulate(load_scenario("as_printed", ["duration=1"]))
    assert trace.info.status == "diverged"
    return trace


def row_of(trace: Trace) -> dict[str, Any]:
    info = trace.info
    told = {"status": info.status, "reason": info.reason, "ticks": len(trace)}
    return {**compute_metrics(trace), **told}


def held_to_the_end(trace: Trace) -> Trace:
    """What a recorder would make of a run that ended early, if it held the last state."""
    missing = trace.scenario.n_ticks - len(trace)
    columns = {
        name: np.concatenate([values, np.repeat(values[-1:], missing, axis=0)])
        for name, values in trace.columns.items()
    }
    columns["t"] = np.arange(trace.scenario.n_ticks) * trace.scenario.dt
    return replace(trace, columns=columns)


def test_a_row_of_a_run_that_diverged_passes(lost: Trace) -> None:
    check_row(row_of(lost), lost)


def test_a_recorder_that_holds_the_last_state_is_caught(lost: Trace) -> None:
    held = held_to_the_end(lost)
    with pytest.raises(AssertionError, match="a frozen tail"):
        check_tail(held)
    with pytest.raises(AssertionError, match="a frozen tail"):
        has_diverged(held)
    with pytest.raises(AssertionError, match="ticks, the run has"):
        check_row(row_of(held), lost)


@pytest.mark.parametrize(
    "wrong",
    [
        {"diverged": False},
        {"status": "ok"},
        {"reason": ""},
        {"ticks": 1000},
        {"rmse": 0.1},
        {"rmse_steady": 1e-4},
        {"tau_peak": 0.0},
    ],
    ids=str,
)
def test_a_row_that_tells_anything_else_is_caught(lost: Trace, wrong: dict[str, Any]) -> None:
    with pytest.raises(AssertionError):
        check_row(row_of(lost) | wrong, lost)


def test_a_run_that_ended_well_may_not_be_flagged() -> None:
    trace = simulate(load_scenario("paper", ["duration=0.1"], controller="pd"))
    check_row(row_of(trace), trace)
    with pytest.raises(AssertionError, match="diverged = True"):
        check_row(row_of(trace) | {"diverged": True}, trace)


def test_what_speaks_of_a_whole_run_is_empty_where_it_diverged(lost: Trace) -> None:
    metrics = compute_metrics(lost)
    assert set(metrics) == METRICS
    assert all(metrics[name] is None for name in WHOLE)
    assert metrics["tau_peak"] == np.abs(lost["tau"]).max()
    whole = replace(lost, info=replace(lost.info, status="ok"))
    assert compute_metrics(whole)["rmse"] is not None
