"""`dnnmso bench`: this package beside what one would otherwise write or use."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dnnmso_mj.cli.shared import Json, listing, number, print_table, working
from dnnmso_mj.extras import require

if TYPE_CHECKING:
    from dnnmso_mj.bench.run import Benchmark
    from dnnmso_mj.bench.timing import Row, Table

UNEQUAL = 1
COLUMNS = ("median", "rounds", "p99", "p99.9", "max", "times slower")


def bench(
    sections: Annotated[
        list[str] | None,
        typer.Argument(help="step, tick, sweep, recording, growth; all unless named."),
    ] = None,
    quick: Annotated[bool, typer.Option(help="Only try it out: seconds, rough numbers.")] = False,
    as_json: Json = False,
) -> None:
    """Time the controller, the loop, sweeps and logs side by side with others."""
    require("sweep", "dnnmso bench")
    from dnnmso_mj.bench.run import run_bench

    done = run_bench(sections or (), quick=quick, working=working)
    if as_json:
        print(json.dumps(done.document()))
    else:
        _print(done)
    if done.unequal:
        print(f"do not compute the same: {'; '.join(done.unequal)}", file=sys.stderr)
        raise typer.Exit(UNEQUAL)


def _print(done: Benchmark) -> None:
    for table in done.tables:
        _print_table(table)
    cores, memory = done.machine["cores"], done.machine["ram_gib"]
    print(f"machine  {done.machine['cpu']}, {cores} cores, {memory} GiB, {done.machine['os']}")
    print(f"load     {done.load_before} before, {done.load_after} after")
    print(f"with     {listing(done.versions)}")
    print(f"commit   {done.git_commit or 'unknown'}, {done.date}, {done.wall_s:.0f} s")
    if done.quick:
        print("quick: too few samples for numbers to be quoted")


def _print_table(table: Table) -> None:
    from rich.table import Table as RichTable

    shown = RichTable(title=f"{table.title} ({table.unit})", caption=table.work)
    cells = {row.name: _cells(row) for row in table.rows}
    used = [k for k in range(len(COLUMNS)) if any(line[k] for line in cells.values())]
    shown.add_column("")
    for k in used:
        shown.add_column(COLUMNS[k], justify="right")
    for name, line in cells.items():
        shown.add_row(name, *(line[k] for k in used))
    print_table(shown)
    for row in table.rows:
        if row.missing:
            print(f"  {row.name}: {row.missing}")
    for check in table.checks:
        verdict = "same" if check.passed else "NOT THE SAME"
        print(f"  {verdict}: {check.what}: {check.error:.1e}, allowed {check.tolerance:g}")
    for name, value in table.details.items():
        print(f"  {name}: {number(value)}")
    print()


def _cells(row: Row) -> list[str]:
    rounds = "" if row.low is None else f"{number(row.low)}–{number(row.high)}"
    tail = [_cell(value) for value in (row.p99, row.p999, row.max, row.ratio)]
    return ["missing" if row.missing else _cell(row.median), rounds, *tail]


def _cell(value: Any) -> str:
    return "" if value is None else number(value)
