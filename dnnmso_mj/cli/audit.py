"""`dnnmso audit`: freeze the weights and see what the model knows."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dnnmso_mj.cli.completing import complete_controllers
from dnnmso_mj.cli.shared import (
    Json,
    Overrides,
    ScenarioName,
    Trust,
    near,
    print_table,
    progress_bar,
    working,
)
from dnnmso_mj.extras import require

if TYPE_CHECKING:
    from dnnmso_mj.audit.run import Audit
    from dnnmso_mj.audit.summary import AuditPoint
    from dnnmso_mj.sweep.statistics import Spread

TIMES_SHOWN = 2  # side by side, in 80 columns


def audit(
    scenario: ScenarioName,
    controllers: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,NAME",
            autocompletion=complete_controllers,
            help="Default: the scenario's own.",
        ),
    ] = None,
    at: Annotated[str, typer.Option(metavar="T,T", help="When to freeze (s).")] = "10,25,50",
    seeds: Annotated[str, typer.Option(metavar="START:STOP", help="Or a number, or a list.")] = (
        "0:10"
    ),
    overrides: Overrides = None,
    out: Annotated[Path | None, typer.Option(help="Folder; default logs.")] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Runs at once; default all cores.")
    ] = None,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Freeze the weights, drive on, drive elsewhere: how much of the plant does the model know?"""
    require("plot", "dnnmso audit")
    from dnnmso_mj.audit.document import document
    from dnnmso_mj.audit.figure import audit_png
    from dnnmso_mj.audit.plan import AuditError, plan_audit
    from dnnmso_mj.audit.run import run_audit
    from dnnmso_mj.files import write_whole
    from dnnmso_mj.paths import logs_dir
    from dnnmso_mj.sweep.plan import parse_seeds

    names = [name.strip() for name in controllers.split(",")] if controllers else []
    with working("checking every controller"):
        times, numbers = _numbers(at), parse_seeds(seeds)
        plan = plan_audit(scenario, names, times, numbers, overrides or (), trust=trust)
    with progress_bar(f"audit of {plan.name}", len(plan.subjects) * len(plan.seeds)) as progress:
        found = run_audit(plan, jobs, progress)
    folder = out or logs_dir()
    files = [folder / f"audit_{plan.name}{suffix}" for suffix in (".json", ".png")]
    text = json.dumps(document(found) | {"files": [str(file) for file in files]})
    with working("drawing the figure"):
        contents = [text.encode(), audit_png(found)]
    for file, content in zip(files, contents, strict=True):
        try:
            write_whole(file, content)
        except OSError as error:
            raise AuditError(f"{file}: cannot be written: {error.strerror or error}") from error
    if as_json:
        print(text)
    else:
        _print_summary(found, files)


def _numbers(text: str) -> list[float]:
    from dnnmso_mj.audit.plan import AuditError

    try:
        return [float(piece) for piece in text.split(",")]
    except ValueError as error:
        allowed = "allowed: times in s, as in 10,25,50"
        raise AuditError(f"--at {text!r}: {error}; {allowed}") from error


def _print_summary(found: Audit, files: Sequence[Path]) -> None:
    times = found.plan.questions.at
    for first in range(0, len(times), TIMES_SHOWN):
        _print_times(found, times[first : first + TIMES_SHOWN])
    for failure in found.failures:
        print("  {controller}, seed {seed}, broke off: {reason}".format(**failure))
    print(f"RMSE in rad; knowledge: 1 all, 0 as much as none; {found.wall_s:.1f} s")
    for file in files:
        print(f"{file.suffix[1:]:8} {near(file)}")


def _print_times(found: Audit, times: Sequence[float]) -> None:
    from rich.table import Table

    from dnnmso_mj.audit.summary import MEASURES

    seeds = len(found.plan.seeds)
    of = "1 seed" if seeds == 1 else f"{seeds} seeds"
    table = Table(title=f"{found.plan.name}: weights frozen, {of}", box=None, pad_edge=False)
    table.add_column("median, 95 % interval", no_wrap=True)
    for time in times:
        table.add_column(f"at {time:g} s", justify="right", no_wrap=True)
    for subject in found.plan.subjects:
        points = [p for p in found.points if p.controller == subject.name and p.at in times]
        table.add_row(subject.name, style="bold")
        for name, words in MEASURES.items():
            table.add_row(f"  {words}", *(_cell(point.measures[name]) for point in points))
        table.add_row("  diverged", *(_diverged(point) for point in points))
    print_table(table)


def _cell(value: Spread) -> str:
    if value.median is None:
        return "none"
    interval = "" if value.ci_low is None else f" {value.ci_low:.3g} to {value.ci_high:.3g}"
    return f"{value.median:.3g}{interval}"


def _diverged(point: AuditPoint) -> str:
    return f"{point.diverged} of {point.runs}"
