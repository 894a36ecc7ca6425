"""`dnnmso sweep`: many runs, one table, and what they say together."""

from __future__ import annotations

import json
import shlex
import signal
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dnnmso_mj.cli.shared import Json, Overrides, near, number, print_table, working

if TYPE_CHECKING:
    from rich.progress import Progress

    from dnnmso_mj.sweep.plan import Plan
    from dnnmso_mj.sweep.run import SweepResult
    from dnnmso_mj.sweep.statistics import Spread
    from dnnmso_mj.sweep.summary import Failure, PointSummary
    from dnnmso_mj.sweep.task import Row

LINE_PERIOD = 30.0  # s between lines of progress where there is no terminal
POINTS_SHOWN = 12
FAILURES_SHOWN = 10
FAILURES_IN_JSON = 100


def sweep(
    scenario: Annotated[str, typer.Argument(help="A scenario file, or the name of a shipped one.")],
    seeds: Annotated[str, typer.Option(metavar="START:STOP", help="Or a number, or a list.")],
    overrides: Overrides = None,
    grid: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY=VALUE,VALUE", help="Several: every combination of them."),
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Runs at once; default all cores.")
    ] = None,
    engine: Annotated[str, typer.Option(help="local, or ray for many machines.")] = "local",
    address: Annotated[
        str | None,
        typer.Option(help="Of a Ray cluster: auto or HOST:PORT; default: start one here."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Default logs/NAME.parquet.")] = None,
    resume: Annotated[bool, typer.Option(help="Go on from what is there.")] = False,
    force: Annotated[bool, typer.Option(help="Start anew whatever is there.")] = False,
    as_json: Json = False,
) -> None:
    """Run many seeds and parameters; one row a run to Parquet."""
    from dnnmso_mj.sweep.plan import parse_seeds, plan_sweep
    from dnnmso_mj.sweep.run import default_out, make_engine, run_sweep
    from dnnmso_mj.sweep.summary import summarise

    runner = make_engine(engine, jobs, address)
    with working("checking every point"):
        plan = plan_sweep(scenario, parse_seeds(seeds), overrides or (), grid or ())
    out = out or default_out(plan)
    command = shlex.join(["dnnmso", *sys.argv[1:]])
    with _watching(plan) as watcher:
        try:
            with _terminated_like_ctrl_c():
                result = run_sweep(
                    plan, out, runner, resume=resume, force=force, watcher=watcher, command=command
                )
        except KeyboardInterrupt as stop:
            watcher.stop()
            raise KeyboardInterrupt(_how_to_go_on(watcher, plan, out)) from stop
    with working("summing up"):
        points = summarise(result.table, plan)
    if as_json:
        print(json.dumps(_document(result, points, plan, engine)))
    else:
        _print_summary(result, points, plan)
    bad = sum(len(point.failures) for point in points)
    if bad:
        print(f"{bad} of {plan.n_runs} runs diverged or failed", file=sys.stderr)


class _Watch:
    """Counts rows, and shows the count: a bar on a terminal, else a line now and then."""

    def __init__(self, plan: Plan, bar: Progress | None) -> None:
        self._name = plan.points[0].scenario.name
        self._bar = bar
        self.done, self.failures = 0, 0
        self._total, self._kept, self._ticks = plan.n_runs, 0, 0
        self._started = self._said = time.monotonic()

    def begin(self, total: int, kept: int) -> None:
        self.done = self._kept = kept
        self._total = total
        self._started = self._said = time.monotonic()
        if self._bar is not None:
            self._task = self._bar.add_task("", total=total, completed=kept, text=self._text())

    def row(self, row: Row) -> None:
        self.done += 1
        self.failures += row["status"] != "ok"
        self._ticks += row["ticks"]
        if self._bar is not None:
            self._bar.update(self._task, completed=self.done, text=self._text())
        elif time.monotonic() - self._said > LINE_PERIOD:
            self._said = time.monotonic()
            print(f"{self._text()}, {self._left()} left", file=sys.stderr, flush=True)

    def stop(self) -> None:
        """Take the bar away before something else is said."""
        if self._bar is not None:
            self._bar.stop()

    def _text(self) -> str:
        passed = max(time.monotonic() - self._started, 1e-9)
        rates = (
            f"{(self.done - self._kept) / passed:.3g} runs/s, {self._ticks / passed:,.0f} ticks/s"
        )
        bad = f", {self.failures} diverged or failed" if self.failures else ""
        return f"{self._name}: {self.done}/{self._total} runs, {rates}{bad}"

    def _left(self) -> str:
        passed = time.monotonic() - self._started
        seconds = round(passed / max(self.done - self._kept, 1) * (self._total - self.done))
        return f"{seconds // 3600}:{seconds // 60 % 60:02}:{seconds % 60:02}"


@contextmanager
def _watching(plan: Plan) -> Iterator[_Watch]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True, markup=False)
    if not console.is_terminal:
        yield _Watch(plan, None)
        return
    columns = (TextColumn("{task.fields[text]}", markup=False), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        yield _Watch(plan, bar)


@contextmanager
def _terminated_like_ctrl_c() -> Iterator[None]:
    """Inside, SIGTERM (a scheduler's way to stop a job) is what Ctrl-C is."""

    def interrupt(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _how_to_go_on(watch: _Watch, plan: Plan, out: Path) -> str:
    words = [word for word in sys.argv[1:] if word not in {"--force", "--resume"}]
    where = f" beside {near(out)}" if watch.done else ""
    command = shlex.join(["dnnmso", *words, "--resume"])
    return f"{watch.done} of {plan.n_runs} rows are kept{where}; to go on:\n  {command}"


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
