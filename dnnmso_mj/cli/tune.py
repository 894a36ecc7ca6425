"""`dnnmso tune`: the best of a budget of trials, as a file that scenarios take."""

from __future__ import annotations

import json
import shlex
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dnnmso_mj.cli.completing import complete_controller
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
)
from dnnmso_mj.cli.watching import LINE_PERIOD, how_to_go_on, terminated_like_ctrl_c
from dnnmso_mj.extras import require

if TYPE_CHECKING:
    from rich.progress import Progress

    from dnnmso_mj.tuning.run import Tuned
    from dnnmso_mj.tuning.search import Request


def tune(
    scenario: ScenarioName,
    controller: Annotated[
        str,
        typer.Option(
            metavar="KIND_OR_FILE",
            autocompletion=complete_controller,
            help="What is tuned, and where the search starts.",
        ),
    ],
    trials: Annotated[int, typer.Option(min=1, help="The budget; the first is the untuned one.")],
    seeds: Annotated[str, typer.Option(metavar="START:STOP", help="The runs of every trial.")],
    out: Annotated[Path, typer.Option(help="The tuned controller (.yaml).")],
    test_seeds: Annotated[
        str | None, typer.Option(metavar="START:STOP", help="Runs that judge the best at the end.")
    ] = None,
    overrides: Overrides = None,
    chatter_scale: Annotated[
        float, typer.Option(help="Chatter at which the error counts √2 times (N·m a step).")
    ] = 0.05,
    max_peak: Annotated[float | None, typer.Option(help="Limit of tau_peak (N·m).")] = None,
    max_chatter: Annotated[
        float | None, typer.Option(help="Limit of tau_chatter (N·m a step).")
    ] = None,
    storage: Annotated[Path | None, typer.Option(help="Default OUT.study.sqlite.")] = None,
    jobs: Jobs = None,
    resume: Resume = False,
    force: Force = False,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Search for a controller's best settings; the winner is a file for `controller: {from: …}`."""
    require("tune", "dnnmso tune")
    from dnnmso_mj.sweep.plan import parse_seeds
    from dnnmso_mj.tuning import TuneInterrupted
    from dnnmso_mj.tuning.objective import Objective
    from dnnmso_mj.tuning.run import default_storage
    from dnnmso_mj.tuning.run import tune as search
    from dnnmso_mj.tuning.search import Request

    request = Request(
        source=scenario,
        controller=controller,
        seeds=parse_seeds(seeds),
        trials=trials,
        sets=overrides or (),
        objective=Objective(chatter_scale, max_peak, max_chatter),
        test_seeds=() if test_seeds is None else parse_seeds(test_seeds),
        trust=trust,
        command=shlex.join(["dnnmso", *sys.argv[1:]]),
    )
    where = storage or default_storage(out)
    with _watching(controller) as watch:
        try:
            with terminated_like_ctrl_c():
                done = search(
                    request, out, where, jobs=jobs, resume=resume, force=force, watcher=watch
                )
        except TuneInterrupted as stop:
            watch.stop()
            raise KeyboardInterrupt(how_to_go_on(stop.done, trials, where, "trials")) from stop
    if as_json:
        print(json.dumps(_document(done, request), allow_nan=False))
    else:
        _print(done, request)


@dataclass
class _Watch:
    """Counts trials, and shows the count: a bar on a terminal, else a line now and then."""

    name: str
    bar: Progress | None

    def begin(self, total: int, kept: int) -> None:
        self._total, self._said = total, time.monotonic()
        if self.bar is not None:
            self._task = self.bar.add_task("", total=total, completed=kept, text=self.name)

    def trial(self, done: int, value: float, best: float) -> None:
        text = f"{self.name}: {done}/{self._total} trials, best {best:.4g}, last {value:.4g}"
        if self.bar is not None:
            self.bar.update(self._task, completed=done, text=text)
        elif time.monotonic() - self._said > LINE_PERIOD:
            self._said = time.monotonic()
            print(text, file=sys.stderr, flush=True)

    def stop(self) -> None:
        """Take the bar away before something else is said."""
        if self.bar is not None:
            self.bar.stop()


@contextmanager
def _watching(name: str) -> Iterator[_Watch]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True, markup=False)
    if not console.is_terminal:
        yield _Watch(name, None)
        return
    columns = (TextColumn("{task.fields[text]}", markup=False), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        yield _Watch(name, bar)


def _document(done: Tuned, request: Request) -> dict[str, Any]:
    return {
        "status": "completed",
        "scenario": done.scenario.name,
        "controller": request.controller,
        "out": str(done.out),
        "storage": str(done.storage),
        "trials": request.trials,
        "trials_kept": done.kept,
        "objective": request.objective.words,
        "best_trial": done.best,
        "parameters": done.parameters,
        "value": done.value,
        "start_value": done.start_value,
        "test_value": done.test_value,
        "test_start_value": done.test_start_value,
    }


def _print(done: Tuned, request: Request) -> None:
    from rich.table import Table

    counted = f"trial {done.best} of 0 to {request.trials - 1} is the best"
    print(f"{request.controller} on {done.scenario.name}: {counted}")
    table = Table(box=None, pad_edge=False)
    for name in ("", "untuned", "tuned"):
        table.add_column(name, justify="right" if name else "left", no_wrap=True)
    table.add_row("objective", number(done.start_value), number(done.value))
    if done.test_value is not None:
        table.add_row("on test seeds", number(done.test_start_value), number(done.test_value))
    for path, value in done.parameters.items():
        table.add_row(path, "", number(value))
    print_table(table)
    print(f"objective  {request.objective.words}")
    if done.kept:
        print(f"{done.kept} of the trials were there before")
    print(f"controller {near(done.out)}")
    print(f"study      {near(done.storage)}")
