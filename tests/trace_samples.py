"""Traces made by hand, and the names of the metrics, for the tests of what is done with a trace."""

from __future__ import annotations

from typing import Any

import numpy as np

from dnnmso_mj.scenario import Scenario
from dnnmso_mj.trace import RunInfo, StepLayout, Trace

METRICS = {
    "rmse",
    "rmse_steady",
    "max_abs_error_steady",
    "tau_peak",
    "tau_chatter",
    "f_err_rms_steady",
    "settling_time",
    "bound_violations",
    "diverged",
    "compute_us_p50",
    "compute_us_p999",
    "deadline_misses",
}
DT = 0.001


def trace_with(
    rows: np.ndarray,
    layout: StepLayout,
    columns: dict[str, Any],
    *,
    status: str = "ok",
    seed: int = 0,
    parts: dict[str, Any] | None = None,
) -> Trace:
    """A trace of `rows` on a true clock, but for the columns given (broadcast)."""
    n_ticks = len(rows)
    for name, given in ({"t": DT * np.arange(n_ticks)} | columns).items():
        values = np.asarray(given, dtype=float)
        per_tick = values.shape == (n_ticks,)
        rows[:, layout.slices[name]] = values[:, None] if per_tick else values
    scenario = Scenario.model_validate(
        {
            "name": "synthetic",
            "initial": {"q": [0.5] * layout.widths["q"]},
            "plant": {"masses": None, "lengths": None},
            "reference": {"kind": "sinusoid"},
            "controller": {"kind": "dnn_mso" if layout.widths["weight_norm"] else "no_network"},
            **(parts or {}),
        }
    )
    return Trace(layout.columns(rows), scenario, RunInfo(status=status, seed=seed))
