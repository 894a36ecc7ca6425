"""Tables of sweeps that are torn or flipped: the same table, or one typed error."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.sweep.table import ROW_SCHEMA, SWEEP, read_table, write_table
from soak.ended import dnnmso
from soak.tally import Form, Tally


def table(rows: int = 300) -> pa.Table:
    """As a sweep leaves one."""
    rng = np.random.default_rng(3)
    values: dict[str, Any] = {"seed": np.arange(rows)}
    for field in list(ROW_SCHEMA)[2:]:
        if pa.types.is_string(field.type):
            values[field.name] = ["ok"] * rows
        elif pa.types.is_boolean(field.type):
            values[field.name] = [False] * rows
        else:
            values[field.name] = pa.array(rng.integers(1, 1000, rows)).cast(field.type)
    provenance = b'{"definition": {"points": [{"parameters": {}}]}}'
    return pa.table(values).replace_schema_metadata({SWEEP.key: provenance})


def tables(form: Form, tally: Tally, folder: Path) -> None:
    """Read damaged tables as `--resume` does, one by `dnnmso report`, and one made to be large."""
    good, path = table(), folder / "damaged.parquet"
    write_table(good, folder / "good.parquet")
    data = (folder / "good.parquet").read_bytes()
    rng = np.random.default_rng(form.seed)
    for k in range(form.pick(100, 3000)):
        bad = bytearray(data)
        if k % 3 == 0:
            bad = bad[: int(rng.integers(len(data)))]
        else:
            for at in rng.integers(0, 8 * len(data), 1 if k % 3 == 1 else 8).tolist():
                bad[at // 8] ^= 1 << at % 8
        path.write_bytes(bad)
        judge(f"table {k} of seed {form.seed}", path, good, tally)
    path.write_bytes(data[: len(data) // 2])
    ended = dnnmso("report", path, "--out", folder / "table.html", cwd=folder)
    with tally.case("report of a torn table"):
        assert ended.is_one_error, ended.err[-300:]
    with tally.case("a table of many equal rows in few bytes"):
        large = pa.table({"seed": pa.array(np.zeros(50_000_000, np.int8))})
        pq.write_table(large.replace_schema_metadata({SWEEP.key: b"{}"}), path)
        before = pa.total_allocated_bytes()
        try:
            read_table(path)
        except DnnmsoError:
            assert pa.total_allocated_bytes() - before < 64e6
        else:
            raise AssertionError("it was read")


def judge(name: str, path: Path, good: pa.Table, tally: Tally) -> None:
    """Count what became of one table."""
    try:
        found, provenance = read_table(path)
    except DnnmsoError:
        tally.survive()
    except Exception as error:
        tally.lose(f"{name}: {type(error).__name__}: {str(error)[:200]}")
    else:
        same = found.equals(good) and provenance == {"definition": {"points": [{"parameters": {}}]}}
        if same:
            tally.survive()
        else:
            tally.admit(f"{name}: other numbers than were written")
