"""A trace as an Arrow table: one column a number, each with its unit."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

import pyarrow as pa

from dnnmso_mj.errors import MissingExtraError

if TYPE_CHECKING:
    import pandas as pd

    from dnnmso_mj.trace import Trace

# Units of the columns of `trace.StepLayout`; of a state's or its derivative's, of either half.
UNITS = {
    "t": "s",
    "q": "rad",
    "qd": "rad/s",
    "q_meas": "rad",
    "qd_meas": "rad/s",
    "q_ref": "rad",
    "qd_ref": "rad/s",
    "tau_cmd": "N·m",
    "tau": "N·m",
    "ultimate_bound": "rad",
    "compute_us": "µs",
    "wake_late_us": "µs",
}
STATES = {
    "x_hat": ("rad", "rad/s"),
    "f_hat": ("rad/s", "rad/s²"),
    "f_true": ("rad/s", "rad/s²"),
    "e_obs": ("rad", "rad/s"),
}
NO_UNIT = "1"


def trace_table(trace: Trace) -> pa.Table:
    """The columns of a trace as `Trace.table` has them."""
    fields, arrays = [], []
    for name in trace:
        values = trace[name]
        columns = values[:, None] if values.ndim == 1 else values
        for k, column in enumerate(columns.T):
            label = name if values.ndim == 1 else f"{name}{k + 1}"
            unit = _unit(name, k, trace.n_joints)
            array = pa.array(column)
            fields.append(pa.field(label, array.type, metadata={"unit": unit}))
            arrays.append(array)
    about = {
        "scenario": trace.scenario.model_dump_json(),
        "seed": str(trace.info.seed),
        "status": trace.info.status,
    }
    return pa.table(arrays, schema=pa.schema(fields, metadata=about))


def trace_frame(trace: Trace) -> pd.DataFrame:
    """The columns of a trace as `Trace.to_pandas` has them."""
    try:
        import_module("pandas")
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            "a data frame needs pandas, which is not installed: pip install pandas"
        ) from error
    frame: pd.DataFrame = trace_table(trace).to_pandas()
    return frame.set_index("t")


def _unit(name: str, k: int, n: int) -> str:
    if name in STATES:
        return STATES[name][0 if k < n else 1]
    return UNITS.get(name, NO_UNIT)
