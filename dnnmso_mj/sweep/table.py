"""The finished table of a sweep: its columns, their types, and the file that holds them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from dnnmso_mj.files import whole_file
from dnnmso_mj.log.json_texts import read_json
from dnnmso_mj.sweep.parquet import TableError, read_parquet, write_parquet
from dnnmso_mj.sweep.plan import Plan, SweepError

METADATA_KEY = b"dnnmso_sweep"
LARGEST = 1 << 24  # characters of a provenance, which has a scenario for each point


@dataclass(frozen=True)
class Kind:
    """A kind of table.

    Args:
        command: what writes it.
        key: of its provenance, JSON in the file's metadata.
        rows: what a row is before its table is finished; begins with point and seed.
    """

    command: str
    key: bytes
    rows: pa.Schema


# The names are `compute_metrics`' own.
METRIC_TYPES: dict[str, pa.DataType] = {
    "rmse": pa.float64(),
    "rmse_steady": pa.float64(),
    "max_abs_error_steady": pa.float64(),
    "tau_peak": pa.float64(),
    "tau_chatter": pa.float64(),
    "f_err_rms_steady": pa.float64(),
    "settling_time": pa.float64(),
    "bound_violations": pa.int64(),
    "diverged": pa.bool_(),
    "compute_us_p50": pa.float64(),
    "compute_us_p999": pa.float64(),
    "deadline_misses": pa.int64(),
}
# What differs from one execution of the same run to the next.
TIMING = ("compute_us_p50", "compute_us_p999", "deadline_misses", "wall_s")

ROW_SCHEMA = pa.schema(
    [
        pa.field("point", pa.int32(), nullable=False),
        pa.field("seed", pa.int64(), nullable=False),
        pa.field("status", pa.string(), nullable=False),
        pa.field("reason", pa.string(), nullable=False),
        *METRIC_TYPES.items(),
        pa.field("ticks", pa.int64(), nullable=False),
        ("wall_s", pa.float64()),
    ]
)
SWEEP = Kind("dnnmso sweep", METADATA_KEY, ROW_SCHEMA)


def finished_table(rows: pa.Table, plan: Plan, provenance: dict[str, Any]) -> pa.Table:
    """Rows in any order, as the table whose order only the plan decides.

    Args:
        rows: of `ROW_SCHEMA`, one for each run.
        plan: gives the parameters of each point.
        provenance: kept as JSON in the metadata.
    """
    rows = rows.sort_by([("point", "ascending"), ("seed", "ascending")])
    columns, fields = [rows["seed"]], [ROW_SCHEMA.field("seed")]
    for name in plan.points[0].parameters:
        values = _column([point.parameters[name] for point in plan.points])
        columns.append(values.take(rows["point"].combine_chunks()))
        fields.append(pa.field(name, values.type))
    for field in list(ROW_SCHEMA)[2:]:
        columns.append(rows[field.name])
        fields.append(field)
    text = json.dumps(provenance, ensure_ascii=False)
    return pa.table(columns, schema=pa.schema(fields, metadata={METADATA_KEY: text}))


def write_table(table: pa.Table, out: Path, *, replace: bool = True) -> None:
    """Write Parquet: whole under its name, or not at all.

    Args:
        table: what is written.
        out: the file.
        replace: whether it may take the place of another one.

    Raises:
        SweepError: the file cannot be written, or is there and may not be replaced.
    """
    try:
        with whole_file(out, replace=replace, sync=True) as file:
            write_parquet(table, file)
    except FileExistsError as error:
        raise SweepError(
            f"{out}: has been made by something else meanwhile, and nothing is written over it; "
            f"the rows are kept beside it; allowed: move it away, then --resume"
        ) from error
    except OSError as error:
        raise SweepError(f"{out}: cannot be written: {error.strerror or error}") from error


def read_table(path: Path, kind: Kind = SWEEP) -> tuple[pa.Table, dict[str, Any]]:
    """A finished table and its provenance.

    Raises:
        SweepError: not a table of this kind.
    """
    try:
        table = read_parquet(path)
        return table, read_json(table.schema.metadata[kind.key].decode(), LARGEST)
    except (OSError, TableError, KeyError, TypeError, ValueError) as error:
        raise SweepError(f"{path}: not a table of `{kind.command}`: {error}") from error


def is_table(path: Path, kind: Kind = SWEEP) -> bool:
    """Whether this is a regular file that holds a finished table of this kind."""
    try:
        return path.is_file() and kind.key in (pq.read_schema(path).metadata or {})
    except (OSError, pa.ArrowException):
        return False


def unfinished_rows(table: pa.Table, n_points: int, kind: Kind = SWEEP) -> pa.Table:
    """A finished table of `n_points` as rows of `kind.rows`, to be added to."""
    per_point = max(1, len(table) // n_points)
    points = pa.array([k // per_point for k in range(len(table))], pa.int32())
    columns = [points, *(table[name] for name in kind.rows.names[1:])]
    return pa.table(columns, schema=kind.rows)


def _column(values: Sequence[Any]) -> pa.Array:
    """Typed where all values are of one kind; JSON text where they are not."""
    kinds = {type(value) for value in values if value is not None}
    if kinds <= {int, float} or (len(kinds) == 1 and not kinds & {list, dict}):
        try:
            return pa.array(values)
        except (pa.ArrowException, OverflowError):
            pass
    return _nested(values, kinds)


def _nested(values: Sequence[Any], kinds: set[type]) -> pa.Array:
    if kinds == {list}:
        try:
            array = pa.array(values)  # whole numbers stay whole
            if array.type in {pa.list_(pa.int64()), pa.list_(pa.float64())}:
                return array
        except (pa.ArrowException, TypeError, OverflowError):
            pass
    return pa.array([json.dumps(value, ensure_ascii=False) for value in values])
