"""`dnnmso margins`: how much of each imperfection controllers stand, as cards and as a matrix."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dnnmso_mj.cli.completing import complete_controllers
from dnnmso_mj.cli.shared import (
    Force,
    Jobs,
    Json,
    Overrides,
    Resume,
    ScenarioName,
    Trust,
    near,
    plain_spread,
    print_table,
    working,
)
from dnnmso_mj.cli.watching import run_watched
from dnnmso_mj.extras import require

if TYPE_CHECKING:
    from dnnmso_mj.margins.cards import Margin, Ranking
    from dnnmso_mj.margins.run import MarginResult

FAILURES_SHOWN = 10
COUNTS = ("none", "below", "capped", "failed", "non_monotone")


def margins(
    scenario: ScenarioName,
    controllers: Annotated[
        str,
        typer.Option(
            metavar="A,B,C",
            autocompletion=complete_controllers,
            help="Shipped tuned controllers, kinds (their defaults), files.",
        ),
    ],
    seeds: Annotated[str, typer.Option(metavar="START:STOP", help="Or a number, or a list.")],
    rows: Annotated[
        str | None,
        typer.Option(
            help="Of delay, payload, friction, noise, model, torque_limit; default all.",
            metavar="A,B,C",
        ),
    ] = None,
    limit: Annotated[
        float, typer.Option(help="Largest rmse_steady that counts as standing (rad).")
    ] = 0.02,
    overrides: Overrides = None,
    jobs: Jobs = None,
    out: Annotated[Path | None, typer.Option(help="Default logs/NAME.margins.parquet.")] = None,
    resume: Resume = False,
    force: Force = False,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Search how much of each imperfection controllers stand."""
    require("sweep", "dnnmso margins")
    from dnnmso_mj.margins.cards import margins_of, rank
    from dnnmso_mj.margins.plan import plan_margins
    from dnnmso_mj.margins.rows import parse_rows
    from dnnmso_mj.margins.run import default_out, run_margins
    from dnnmso_mj.sweep.plan import parse_seeds

    names = [name.strip() for name in controllers.split(",")]
    asked, numbers = parse_rows(rows), parse_seeds(seeds)
    with working("checking every controller and row"):
        sets = overrides or ()
        plan = plan_margins(scenario, names, asked, numbers, sets, limit, trust=trust)
    out = out or default_out(plan)
    result = run_watched(
        plan.points[0].scenario.name,
        plan.n_runs,
        out,
        lambda watcher, command: run_margins(
            plan, out, jobs, resume=resume, force=force, watcher=watcher, command=command
        ),
        bad=("none", "failed"),
    )
    lines = margins_of(result.table, result.provenance)
    ranking = rank(lines, result.provenance)
    if as_json:
        print(json.dumps(_document(result, lines, ranking), allow_nan=False))
    else:
        _print_all(result, lines, ranking)


def _document(
    result: MarginResult, lines: Sequence[Margin], ranking: Mapping[str, Ranking]
) -> dict[str, Any]:
    from dnnmso_mj.margins.cards import unfound

    provenance = result.provenance
    return {
        "status": "completed",
        "scenario": provenance["definition"]["scenarios"][lines[0].controller]["name"],
        "out": str(result.out),
        "rows": len(result.table),
        "rows_kept": result.kept,
        "jobs": result.jobs,
        "wall_s": result.wall_s,
        "limit": provenance["limit"],
        "controllers": provenance["controllers"],
        "model_free": provenance["model_free"],
        "definitions": provenance["rows"],
        "margins": [vars(line) | {"spread": plain_spread(line.spread)} for line in lines],
        "ranking": {name: vars(found) for name, found in ranking.items()},
        "failures": [vars(found) for found in unfound(result.table)],
    }


def _print_all(
    result: MarginResult, lines: Sequence[Margin], ranking: Mapping[str, Ranking]
) -> None:
    from dnnmso_mj.margins.cards import unfound

    rows = result.provenance["rows"]
    for name in result.provenance["controllers"]:
        _print_card(name, [line for line in lines if line.controller == name], rows)
    _print_matrix(result.provenance, lines, ranking)
    failures = unfound(result.table)
    for found in failures[:FAILURES_SHOWN]:
        where = f"{found.controller}, seed {found.seed}, {', '.join(found.rows)}"
        print(f"{where}: {found.status}: {found.reason}")
    if len(failures) > FAILURES_SHOWN:
        print(f"… and {len(failures) - FAILURES_SHOWN} more; --json has them all")
    print(f"stands: not diverged, and rmse_steady <= {result.provenance['limit']:g} rad")
    if result.kept:
        print(f"{result.kept} of {len(result.table)} searches were there before")
    print(f"{len(result.table)} searches in {result.wall_s:.2f} s, {result.jobs} at once")
    print(f"table    {near(result.out)}")


def _print_card(name: str, lines: Sequence[Margin], rows: Mapping[str, Any]) -> None:
    from rich.table import Table

    from dnnmso_mj.margins.cards import interval_text, value_text

    table = Table(title=f"margin card of {name}", box=None, pad_edge=False)
    table.add_column("row", no_wrap=True)
    table.add_column("median", justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    table.add_column("95 % of median", justify="right", no_wrap=True)
    table.add_column("seeds", justify="right", no_wrap=True)
    table.add_column("remarks")
    for line in lines:
        row = rows[line.row]
        if line.unused:
            table.add_row(line.row, "", "", "", "", line.unused)
            continue
        counts = [f"{getattr(line, key)} {key}" for key in COUNTS if getattr(line, key)]
        median = value_text(line.spread.median, row)
        interval = interval_text(line, row)
        remarks = ", ".join(counts).replace("_", "-")
        table.add_row(line.row, median, row["unit"], interval, str(line.spread.n), remarks)
    print_table(table)
    print()


def _print_matrix(
    provenance: Mapping[str, Any], lines: Sequence[Margin], ranking: Mapping[str, Ranking]
) -> None:
    from rich.table import Table

    from dnnmso_mj.margins.cards import cell_text

    rows = provenance["rows"]
    table = Table(title="medians", box=None, pad_edge=False)
    table.add_column("controller")
    for name, row in rows.items():
        unit = f"\n({row['unit']})" if row["unit"] else ""
        table.add_column(f"{name}{unit}".replace("_", "\n", 1), justify="right", no_wrap=True)
    for name in provenance["controllers"]:
        mine = [line for line in lines if line.controller == name]
        title = name if name in provenance["model_free"] else f"{name} †"
        table.add_row(title, *(cell_text(line, rows[line.row], ranking) for line in mine))
    print_table(table)
    print("† has a model; of the others: ** the best median, * its interval meets the best's")
    print()
