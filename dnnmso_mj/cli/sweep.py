"""`dnnmso sweep`: many runs, one table, and what they say together."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dnnmso_mj.cli.shared import (
    Force,
    Jobs,
    Json,
    Overrides,
    Resume,
    ScenarioName,
    Trust,
    near,
    number,
    print_table,
    working,
)
from dnnmso_mj.cli.watching import run_watched
from dnnmso_mj.extras import require

if TYPE_CHECKING:
    from dnnmso_mj.sweep.plan import Plan
    from dnnmso_mj.sweep.run import SweepResult
    from dnnmso_mj.sweep.statistics import Spread
    from dnnmso_mj.sweep.summary import Failure, PointSummary

POINTS_SHOWN = 12
LISTENS = (
    "For the cluster this machine listens on all its addresses until the sweep is over: whoever "
    "reaches them needs no password."
)
FAILURES_SHOWN = 10
FAILURES_IN_JSON = 100


def sweep(
    scenario: ScenarioName,
    seeds: Annotated[str, typer.Option(metavar="START:STOP", help="Or a number, or a list.")],
    overrides: Overrides = None,
    grid: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY=VALUE,VALUE", help="Several: every combination of them."),
    ] = None,
    jobs: Jobs = None,
    engine: Annotated[str, typer.Option(help="local, or ray for many machines.")] = "local",
    address: Annotated[
        str | None,
        typer.Option(help="Of a Ray cluster: auto or HOST:PORT; default: start one here."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Default logs/NAME.parquet.")] = None,
    resume: Resume = False,
    force: Force = False,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Run many seeds and parameters; one row a run to Parquet."""
    require("ray" if engine == "ray" else "sweep", "dnnmso sweep")
    from dnnmso_mj.sweep.plan import parse_seeds, plan_sweep
    from dnnmso_mj.sweep.run import default_out, make_engine, run_sweep
    from dnnmso_mj.sweep.summary import summarise

    runner = make_engine(engine, jobs, address)
    if address is not None:
        print(LISTENS, file=sys.stderr)
    with working("checking every point"):
        numbers = parse_seeds(seeds)
        plan = plan_sweep(scenario, numbers, overrides or (), grid or (), trust=trust)
    out = out or default_out(plan)
    result = run_watched(
        plan.points[0].scenario.name,
        plan.n_runs,
        out,
        lambda watcher, command: run_sweep(
            plan, out, runner, resume=resume, force=force, watcher=watcher, command=command
        ),
    )
    with working("summing up"):
        points = summarise(result.table, plan)
    if as_json:
        print(json.dumps(_document(result, points, plan, engine)))
    else:
        _print_summary(result, points, plan)
    bad = sum(len(point.failures) for point in points)
    if bad:
        print(f"{bad} of {plan.n_runs} runs diverged or failed", file=sys.stderr)


def _document(
    result: SweepResult, points: Sequence[PointSummary], plan: Plan, engine: str
) -> dict[str, Any]:
    failures = [failure for point in points for failure in point.failures]
    return {
        "status": "completed",
        "scenario": plan.points[0].scenario.name,
        "out": str(result.out),
        "rows": len(result.table),
        **_counts(points),
        "rows_kept": result.kept,
        "engine": engine,
        "jobs": result.jobs,
        "wall_s": result.wall_s,
        "ticks": result.ticks,
        "ticks_per_s": result.ticks / result.wall_s,
        "points": [
            {
                "parameters": point.parameters,
                "runs": point.runs,
                **_counts([point]),
                "metrics": {name: vars(spread) for name, spread in point.metrics.items()},
            }
            for point in points
        ],
        "failures": [vars(failure) for failure in failures[:FAILURES_IN_JSON]],
        "failures_left_out": max(0, len(failures) - FAILURES_IN_JSON),
    }


def _counts(points: Sequence[PointSummary]) -> dict[str, int]:
    counts = {"ok": sum(point.ok for point in points)}
    for status in ("diverged", "failed"):
        counts[status] = sum(point.count(status) for point in points)
    return counts


def _print_summary(result: SweepResult, points: Sequence[PointSummary], plan: Plan) -> None:
    varied = [
        name
        for name in points[0].parameters
        if any(point.parameters[name] != points[0].parameters[name] for point in points)
    ]
    name = plan.points[0].scenario.name
    for point in points[:POINTS_SHOWN]:
        here = ", ".join(f"{key} = {point.parameters[key]}" for key in varied)
        _print_point(point, f"{name}, {here}" if here else name)
    if len(points) > POINTS_SHOWN:
        print(f"… and {len(points) - POINTS_SHOWN} more points; --json has them all")
    spreads = [spread for point in points for spread in point.metrics.values()]
    methods = {spread.ci_method for spread in spreads if spread.ci_method is not None}
    if methods:
        print(f"95 % of median: by {' and, where runs are many, by '.join(sorted(methods))}")
    _print_failures([failure for point in points for failure in point.failures], varied)
    counts = ", ".join(f"{count} {status}" for status, count in _counts(points).items())
    print(f"{len(result.table)} runs: {counts}")
    if result.kept:
        print(f"{result.kept} of them were there before")
    rate = f"{result.ticks / result.wall_s:,.0f} ticks/s"
    print(f"{result.ticks} ticks in {result.wall_s:.2f} s, {result.jobs} at once: {rate}")
    print(f"table    {near(result.out)}")


def _print_point(point: PointSummary, title: str) -> None:
    from rich.table import Table

    title = f"{title}: {point.ok} of {point.runs} runs ok"
    if point.ok == 0:
        print(title)
        return
    table = Table(title=title, box=None, pad_edge=False)  # so that it fits 80 columns
    table.add_column("metric", no_wrap=True)
    for name in ("runs", "median", "quartiles", "95 % of median"):
        table.add_column(name, justify="right", no_wrap=True)
    for name, spread in point.metrics.items():
        table.add_row(name, *_cells(spread))
    print_table(table)
    print()


def _cells(spread: Spread) -> tuple[str, str, str, str]:
    if spread.n == 0:
        return "0", "none", "", ""
    quartiles = f"{number(spread.q25)}–{number(spread.q75)}"
    interval = "too few runs"
    if spread.ci_low is not None:
        interval = f"{number(spread.ci_low)}–{number(spread.ci_high)}"
    return str(spread.n), number(spread.median), quartiles, interval


def _print_failures(failures: Sequence[Failure], varied: Sequence[str]) -> None:
    if not failures:
        return
    print("not in the statistics above:")
    for failure in failures[:FAILURES_SHOWN]:
        here = _where(failure.parameters, varied)
        print(f"  seed {failure.seed}{here} {failure.status}: {failure.reason}")
    if len(failures) > FAILURES_SHOWN:
        print(f"  … and {len(failures) - FAILURES_SHOWN} more; the table has them all")


def _where(parameters: Mapping[str, Any], varied: Sequence[str]) -> str:
    return "".join(f", {key} = {parameters[key]}" for key in varied)
