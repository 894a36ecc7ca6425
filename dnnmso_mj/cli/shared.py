"""What several commands have in common: options, exit statuses, tables and bars."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dnnmso_mj.cli.completing import complete_log, complete_scenario, complete_set
from dnnmso_mj.interrupts import raise_lost
from dnnmso_mj.paths import find_log

if TYPE_CHECKING:
    from rich.table import Table

    from dnnmso_mj.simulation import Progress
    from dnnmso_mj.sweep.statistics import Spread

DIVERGED = 1
BAD_INPUT = 2
INTERRUPTED = 130
UNLIMITED = 10_000  # columns
LABELS = {"error": "bold red", "warning": "bold yellow"}

Log = Annotated[
    Path,
    typer.Argument(
        metavar="LOG",
        parser=find_log,
        autocompletion=complete_log,
        help="A log (.mcap), the name of one in logs, or last.",
    ),
]
Logs = Annotated[
    list[Path],
    typer.Argument(
        metavar="LOG...",
        parser=find_log,
        autocompletion=complete_log,
        help="Logs (.mcap), names of some in logs, or last.",
    ),
]
ScenarioName = Annotated[
    str,
    typer.Argument(
        autocompletion=complete_scenario, help="A scenario file, or the name of a shipped one."
    ),
]
Jobs = Annotated[int | None, typer.Option(min=1, help="Runs at once; default all cores.")]
Resume = Annotated[bool, typer.Option(help="Go on from what is there.")]
Force = Annotated[bool, typer.Option(help="Start anew whatever is there.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        autocompletion=complete_set,
        help="Change a key, e.g. plant.gravity=1.62.",
    ),
]
Trust = Annotated[
    bool, typer.Option("--trust", help="Run code that the scenario names, and read files anywhere.")
]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]


def working(what: str) -> AbstractContextManager[object]:
    """A spinner on standard error, when that is a terminal, for work of unknown length."""
    from rich.console import Console

    raise_lost()
    console = Console(stderr=True)
    return console.status(f"{what} …") if console.is_terminal else nullcontext()


@contextmanager
def progress_bar(name: str, total: int | None) -> Iterator[Progress]:
    """A bar on standard error, when that is a terminal; it takes the number of new steps.

    Without a total (None) it says only that something goes on.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
    from rich.progress import TimeRemainingColumn as TimeColumn

    console = Console(stderr=True)
    raise_lost()
    columns = (TextColumn(name), BarColumn(), TaskProgressColumn(), TimeColumn())
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task(name, total=total)
        yield lambda done: bar.advance(task, done)


def print_table(table: Table, soft_wrap: bool = False, *, wide: bool = False) -> None:
    """Print a table on standard output, square brackets as they are.

    Args:
        table: what is printed.
        soft_wrap: whether a terminal breaks lines that are too long.
        wide: whether lines may be of any length where there is no terminal.
    """
    from rich.console import Console

    console = Console(markup=False, soft_wrap=soft_wrap)
    if wide and not sys.stdout.isatty():
        console.width = UNLIMITED
    console.print(table)


def say(label: str, text: str) -> None:
    """Print "label: text" on standard error, the label in colour on a terminal."""
    if not (sys.stderr.isatty() or "FORCE_COLOR" in os.environ):
        print(f"{label}: {text}", file=sys.stderr)
        return
    from rich.console import Console
    from rich.text import Text

    console = Console(stderr=True, highlight=False, soft_wrap=True)
    console.print(Text.assemble((label, LABELS[label]), f": {text}"))


def near(path: Path) -> Path:
    """The path as a person here would type it."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path


def number(value: Any) -> str:
    """A metric in four digits; "none" for one that has no value."""
    return f"{value:.4g}" if isinstance(value, float) else "none" if value is None else str(value)


def listing(items: Mapping[str, object]) -> str:
    """Names and values on one line."""
    return ", ".join(f"{name} {value}" for name, value in items.items())


def plain_spread(spread: Spread) -> dict[str, Any]:
    """A spread for JSON, which has no infinity: "inf" and "-inf" are texts in it."""
    endless = {math.inf: "inf", -math.inf: "-inf"}
    return {name: endless.get(value, value) for name, value in vars(spread).items()}
