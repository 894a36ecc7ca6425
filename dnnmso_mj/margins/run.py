"""Margins from their plan to their table; what is searched is kept as it comes."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from dnnmso_mj.margins.plan import MarginPlan, model_free
from dnnmso_mj.margins.rows import ROWS
from dnnmso_mj.margins.search import HALVINGS, PRECISION, PROBES_BELOW
from dnnmso_mj.paths import logs_dir
from dnnmso_mj.provenance import software_versions
from dnnmso_mj.sweep.journal import Journal
from dnnmso_mj.sweep.local import LocalEngine
from dnnmso_mj.sweep.plan import seeds_text
from dnnmso_mj.sweep.run import Watcher, complete, refuse_both
from dnnmso_mj.sweep.table import Kind

METADATA_KEY = b"dnnmso_margins"
ROW_SCHEMA = pa.schema(
    [
        pa.field("point", pa.int32(), nullable=False),
        pa.field("seed", pa.int64(), nullable=False),
        pa.field("status", pa.string(), nullable=False),
        pa.field("reason", pa.string(), nullable=False),
        ("margin", pa.float64()),
        ("fails_at", pa.float64()),
        ("non_monotone", pa.int64()),
        ("runs", pa.int64()),
        pa.field("ticks", pa.int64(), nullable=False),
        ("wall_s", pa.float64()),
    ]
)
MARGINS = Kind("dnnmso margins", METADATA_KEY, ROW_SCHEMA)


@dataclass(frozen=True)
class MarginResult:
    """Finished margins.

    Args:
        out: the Parquet file.
        table: what it holds: one row a search, by controller, row and seed.
        provenance: as in its metadata.
        kept: rows that were there before.
        wall_s: from the first task to the written table (s).
        jobs: searches at once.
    """

    out: Path
    table: pa.Table
    provenance: dict[str, Any]
    kept: int
    wall_s: float
    jobs: int


def default_out(plan: MarginPlan) -> Path:
    """logs/NAME.margins.parquet under the current directory."""
    return logs_dir() / f"{plan.points[0].scenario.name}.margins.parquet"


def run_margins(
    plan: MarginPlan,
    out: Path | None = None,
    jobs: int | None = None,
    *,
    resume: bool = False,
    force: bool = False,
    watcher: Watcher | None = None,
    command: str = "",
) -> MarginResult:
    """Search what a plan asks for and leave one Parquet table.

    But for the column wall_s it is the same however many workers made it and however often it was
    interrupted and gone on with: finished rows are in OUT.journal until the table is written.

    Args:
        plan: from `plan_margins`.
        out: the table; by default `default_out`.
        jobs: worker processes; None takes every core.
        resume: go on from what is there; start where nothing is.
        force: start anew whatever is there.
        watcher: told of every row.
        command: what a person would type; kept in the table's metadata.

    Raises:
        SweepError: `out` is taken or cannot be written, what is there is of other margins, rows
            are missing, or the workers cannot be started.
    """
    refuse_both(resume, force)
    out, engine = out or default_out(plan), LocalEngine(jobs)
    started = time.perf_counter()
    with Journal(out, plan, MARGINS, resume=resume, force=force) as journal:
        kept = journal.n_done
        rows, _ = complete(
            journal, plan.n_runs, lambda: engine.rows(plan.tasks(journal.done)), watcher
        )
        provenance = _provenance(plan, command)
        table = _finished(rows, plan, provenance)
        journal.publish(table)
    return MarginResult(out, table, provenance, kept, time.perf_counter() - started, engine.jobs)


def _finished(rows: pa.Table, plan: MarginPlan, provenance: dict[str, Any]) -> pa.Table:
    """Rows in the plan's order, each with the names of its controller and row."""
    rows = rows.sort_by([("point", "ascending"), ("seed", "ascending")])
    points = [plan.points[k] for k in rows["point"].to_pylist()]
    columns = {
        "controller": pa.array([cell.controller for cell in points], pa.string()),
        "row": pa.array([cell.row for cell in points], pa.string()),
        **{name: rows[name] for name in ROW_SCHEMA.names[1:]},
    }
    text = json.dumps(provenance, ensure_ascii=False)
    return pa.table(columns).replace_schema_metadata({METADATA_KEY: text})


def _provenance(plan: MarginPlan, command: str) -> dict[str, Any]:
    """All that it takes to make the table again and to read it."""
    return {
        "command": command,
        "scenario": plan.source,
        "seeds": seeds_text(plan.seeds),
        "controllers": list(plan.controllers),
        "model_free": list(model_free(plan)),
        "limit": plan.limit,
        "rows": {name: _row_document(name) for name in plan.rows},
        "search": {
            "precision": PRECISION,
            "halvings": HALVINGS,
            "probes_below": list(PROBES_BELOW),
        },
        "software": software_versions(),
        "definition": plan.definition(),
    }


def _row_document(name: str) -> dict[str, Any]:
    row = ROWS[name]
    return {
        "what": row.what,
        "unit": row.unit,
        "first": row.value(row.start),
        "easiest": row.value(row.start / 2**HALVINGS),
        "cap": row.at_cap,
        "better": "smaller" if row.smaller else "larger",
    }
