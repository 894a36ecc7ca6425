"""How far a long command is, and how it is stopped and gone on with."""

from __future__ import annotations

import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from dnnmso_mj.cli.shared import near
from dnnmso_mj.interrupts import raise_lost

if TYPE_CHECKING:
    from rich.progress import Progress

    from dnnmso_mj.sweep.task import Row

Result = TypeVar("Result")

LINE_PERIOD = 30.0  # s between lines of progress where there is no terminal


class Watch:
    """Counts rows, and shows the count: a bar on a terminal, else a line now and then.

    Args:
        name: of what is run.
        bar: None without a terminal.
        bad: statuses of rows that are counted as gone wrong.
    """

    def __init__(self, name: str, bar: Progress | None, bad: tuple[str, ...]) -> None:
        self._name, self._bar, self._bad = name, bar, bad
        self.done, self.failures = 0, 0
        self._total, self._kept, self._ticks = 0, 0, 0
        self._started = self._said = time.monotonic()

    def begin(self, total: int, kept: int) -> None:
        self.done = self._kept = kept
        self._total = total
        self._started = self._said = time.monotonic()
        if self._bar is not None:
            self._task = self._bar.add_task("", total=total, completed=kept, text=self._text())

    def row(self, row: Row) -> None:
        raise_lost()
        self.done += 1
        self.failures += row["status"] in self._bad
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
        bad = f", {self.failures} {' or '.join(self._bad)}" if self.failures else ""
        return f"{self._name}: {self.done}/{self._total} runs, {rates}{bad}"

    def _left(self) -> str:
        passed = time.monotonic() - self._started
        seconds = round(passed / max(self.done - self._kept, 1) * (self._total - self.done))
        return f"{seconds // 3600}:{seconds // 60 % 60:02}:{seconds % 60:02}"


@contextmanager
def watching(name: str, bad: tuple[str, ...] = ("diverged", "failed")) -> Iterator[Watch]:
    """A watcher of many runs, its bar taken away at the end; see `Watch`."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    raise_lost()
    console = Console(stderr=True, markup=False)
    if not console.is_terminal:
        yield Watch(name, None, bad)
        return
    columns = (TextColumn("{task.fields[text]}", markup=False), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        yield Watch(name, bar, bad)


@contextmanager
def terminated_like_ctrl_c() -> Iterator[None]:
    """Inside, SIGTERM (a scheduler's way to stop a job) is what Ctrl-C is."""

    def interrupt(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def run_watched(
    name: str,
    total: int,
    out: Path,
    run: Callable[[Watch, str], Result],
    bad: tuple[str, ...] = ("diverged", "failed"),
) -> Result:
    """Do what makes rows; Ctrl-C or SIGTERM says what is kept, and how to go on.

    Args:
        name: of what is run.
        total: rows that there will be.
        out: the table.
        run: takes the watcher, and the command as a person would type it.
        bad: statuses of rows that are counted as gone wrong.
    """
    with watching(name, bad) as watcher:
        try:
            with terminated_like_ctrl_c():
                return run(watcher, shlex.join(["dnnmso", *sys.argv[1:]]))
        except KeyboardInterrupt as stop:
            watcher.stop()
            raise KeyboardInterrupt(how_to_go_on(watcher.done, total, out)) from stop


def how_to_go_on(done: int, total: int, out: Path, what: str = "rows") -> str:
    """What an interrupted command has kept, and the command that goes on.

    Args:
        done: how much is kept.
        total: of how much.
        out: what it is kept beside.
        what: it is.
    """
    words = [word for word in sys.argv[1:] if word not in {"--force", "--resume"}]
    where = f" beside {near(out)}" if done else ""
    command = shlex.join(["dnnmso", *words, "--resume"])
    return f"{done} of {total} {what} are kept{where}; to go on:\n  {command}"
