"""`dnnmso compare`: controllers on the same seeds, ranked, and how sure the ranking is."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
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
    number,
    plain_spread,
    print_table,
    working,
)
from dnnmso_mj.cli.watching import run_watched
from dnnmso_mj.extras import require

if TYPE_CHECKING:
    from dnnmso_mj.comparison.pairing import Pairing
    from dnnmso_mj.comparison.summary import Comparison, Standing
    from dnnmso_mj.sweep.run import SweepResult
    from dnnmso_mj.sweep.statistics import Spread

FAILURES_SHOWN = 10
UNITS = {
    "rmse_steady": "rad",
    "tau_peak": "N·m",
    "tau_chatter": "N·m a step",
    "compute_us_p50": "µs",
}


def compare(
    scenario: ScenarioName,
    controllers: Annotated[
        str,
        typer.Option(
            metavar="A,B,C",
            autocompletion=complete_controllers,
            help="Shipped tuned controllers, kinds (their defaults), files; all against the first.",
        ),
    ],
    seeds: Annotated[str, typer.Option(metavar="START:STOP", help="The same for each.")],
    overrides: Overrides = None,
    jobs: Jobs = None,
    out: Annotated[Path | None, typer.Option(help="Default logs/NAME.compare.parquet.")] = None,
    resume: Resume = False,
    force: Force = False,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Hold controllers against one another, seed by seed; one row a run to Parquet."""
    require("sweep", "dnnmso compare")
    from dnnmso_mj.comparison.plan import default_out, parse_controllers, plan_comparison
    from dnnmso_mj.comparison.summary import summarise
    from dnnmso_mj.sweep.local import LocalEngine
    from dnnmso_mj.sweep.plan import parse_seeds
    from dnnmso_mj.sweep.run import run_sweep

    names, numbers = parse_controllers(controllers), parse_seeds(seeds)
    with working("checking every controller"):
        plan = plan_comparison(scenario, names, numbers, overrides or (), trust=trust)
    out = out or default_out(plan)
    engine, name = LocalEngine(jobs), plan.points[0].scenario.name
    result = run_watched(
        name,
        plan.n_runs,
        out,
        lambda watcher, command: run_sweep(
            plan, out, engine, resume=resume, force=force, watcher=watcher, command=command
        ),
    )
    with working("summing up"):
        found = summarise(result.table)
    if as_json:
        print(json.dumps(_document(found, result, name, names[0]), allow_nan=False))
    else:
        _print(found, result, name)


def _document(
    found: Comparison, result: SweepResult, scenario: str, against: str
) -> dict[str, Any]:
    standings = [
        {
            "rank": rank,
            "controller": standing.controller,
            "runs": standing.runs,
            "diverged": standing.count("diverged"),
            "failed": standing.count("failed"),
            "metrics": {name: plain_spread(spread) for name, spread in standing.metrics.items()},
            "failures": [
                {"seed": bad.seed, "status": bad.status, "reason": bad.reason}
                for bad in standing.failures
            ],
        }
        for rank, standing in enumerate(found.standings, start=1)
    ]
    pairings = [vars(item) | {"log_ratio": plain_spread(item.log_ratio)} for item in found.pairings]
    return {
        "status": "completed",
        "scenario": scenario,
        "out": str(result.out),
        "rows": len(result.table),
        "rows_kept": result.kept,
        "jobs": result.jobs,
        "wall_s": result.wall_s,
        "against": against,
        "standings": standings,
        "pairings": pairings,
    }


def _print(found: Comparison, result: SweepResult, scenario: str) -> None:
    _print_standings(found.standings, f"{scenario}: median and its 95 % interval")
    print("a run that diverged or failed counts as ∞, but not in the time of a tick")
    print()
    _print_pairings(found.pairings, "rmse_steady, paired by seed")
    failures = [failure for standing in found.standings for failure in standing.failures]
    for failure in failures[:FAILURES_SHOWN]:
        name = failure.parameters["controller"]
        print(f"  {name}, seed {failure.seed} {failure.status}: {failure.reason}")
    if len(failures) > FAILURES_SHOWN:
        print(f"  … and {len(failures) - FAILURES_SHOWN} more; the table has them all")
    print(f"{len(result.table)} runs in {result.wall_s:.2f} s, {result.jobs} at once")
    if result.kept:
        print(f"{result.kept} of them were there before")
    print(f"table    {near(result.out)}")


def _print_standings(standings: Sequence[Standing], title: str) -> None:
    """One line a metric, since names and intervals of four metrics are wider than a terminal."""
    from rich.table import Table

    table = Table(title=title, box=None, pad_edge=False)
    for name in ("", "controller", "metric"):
        table.add_column(name, no_wrap=name == "metric")
    for name in ("median", "95 %", "unit"):
        table.add_column(name, justify="right" if name != "unit" else "left", no_wrap=True)
    for rank, standing in enumerate(standings, start=1):
        bad = f"{standing.count('diverged')} diverged, {standing.count('failed')} failed"
        heads = [f"{rank}", standing.controller], ["", f"{standing.runs} runs"], ["", bad]
        rows = [*heads, *[["", ""]] * max(0, len(standing.metrics) - len(heads))]
        for head, (name, spread) in zip(rows, standing.metrics.items(), strict=True):
            table.add_row(*head, name, _short(spread.median), _interval(spread), UNITS[name])
        table.add_section()
    print_table(table)


def _print_pairings(pairings: Sequence[Pairing], title: str) -> None:
    from rich.table import Table

    table = Table(title=f"{title}, against {pairings[0].against}", box=None, pad_edge=False)
    table.add_column("controller")
    for name in ("ratio", "95 %", "wins", "losses", "ties", "p", "p (Holm)"):
        table.add_column(name, justify="right", no_wrap=True)
    for item in pairings:
        counts = (str(item.wins), str(item.losses), str(item.ties))
        p = (f"{item.p:.2g}", f"{item.p_holm:.2g}")
        ratio = _short(_ratio(item.log_ratio.median))
        table.add_row(item.controller, ratio, _interval(item.log_ratio, ratio=True), *counts, *p)
    print_table(table)


def _interval(spread: Spread, *, ratio: bool = False) -> str:
    if spread.ci_low is None:
        return "too few runs"
    ends = (spread.ci_low, spread.ci_high)
    return "–".join(_short(_ratio(end) if ratio else end) for end in ends)


def _ratio(log_ratio: float | None) -> float | None:
    """What a log ratio is the logarithm of: under 1 the controller is better."""
    if log_ratio is None:
        return None
    return math.inf if log_ratio == math.inf else math.exp(log_ratio)


def _short(value: float | None) -> str:
    return "∞" if value == math.inf else number(value)
