"""Processes that begin with everything imported: forked from one that has done so.

They are real processes, killed by real signals, at a hundredth of what a new interpreter costs.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(["soak.ready"])

Process = multiprocessing.process.BaseProcess
Function = Callable[..., object]


@dataclass(frozen=True)
class Told:
    """How a forked command ended, and what it printed."""

    status: int | None
    out: str
    err: str

    @property
    def is_one_error(self) -> bool:
        """Refused as a person expects: status 2, `error: …` once, and no traceback."""
        one = self.err.count("error: ") == 1 and "Traceback" not in self.err
        return self.status == 2 and one


def start(function: Function, *arguments: Any) -> Process:
    """Run a function of a module in a process, and process group, of its own."""
    words = os.environ.get("PYTHONPATH", "")
    os.environ["PYTHONPATH"] = os.pathsep.join([*filter(None, sys.path), words])
    try:
        process = _CONTEXT.Process(target=_lead, args=(function, arguments), daemon=False)
        process.start()
    finally:
        os.environ["PYTHONPATH"] = words
    return process


def warm_up() -> None:
    """Have the first process ready, so that none of those that are timed waits for it."""
    process = start(print, end := "", end)
    process.join()


def command(
    arguments: Sequence[str | Path],
    folder: Path,
    prepare: Function | None = None,
    *given: Any,
    seconds: float = 60.0,
) -> Told:
    """`dnnmso ARGUMENTS` in a folder, after `prepare(*given)` in its process."""
    return ended(begin(arguments, folder, prepare, *given), folder, seconds)


def begin(
    arguments: Sequence[str | Path], folder: Path, prepare: Function | None = None, *given: Any
) -> Process:
    """As `command`, but do not wait; what it prints is kept beside the folder."""
    words = [str(word) for word in arguments]
    return start(_command, words, str(folder), prepare, given)


def ended(process: Process, folder: Path, seconds: float = 60.0) -> Told:
    """Wait for what `begin` has started; the status is None where it took too long."""
    process.join(seconds)
    status = process.exitcode
    if status is None:
        kill(process)
    texts = [_beside(str(folder), process.pid or 0, name) for name in ("out", "err")]
    told = [path.read_text(errors="replace") if path.exists() else "" for path in texts]
    for path in texts:
        path.unlink(missing_ok=True)
    return Told(status, *told)


def kill(process: Process) -> int:
    """SIGKILL to it and what it has forked, and wait; the time (ns) at which it was sent."""
    assert process.pid, "it has not been started"
    at = time.monotonic_ns()
    with suppress(ProcessLookupError):  # it may not lead a group yet
        os.killpg(process.pid, signal.SIGKILL)
    process.kill()
    process.join()
    return at


def _lead(function: Function, arguments: Sequence[Any]) -> None:
    os.setsid()
    function(*arguments)


def _beside(folder: str, pid: int, name: str) -> Path:
    return Path(f"{folder}.{pid}.{name}")


def _command(words: list[str], folder: str, prepare: Function | None, given: Sequence[Any]) -> None:
    for number, name in ((1, "out"), (2, "err")):
        file = os.open(_beside(folder, os.getpid(), name), os.O_WRONLY | os.O_CREAT, 0o600)
        os.dup2(file, number)
        os.close(file)
    os.chdir(folder)
    sys.argv = ["dnnmso", *words]
    if prepare is not None:
        prepare(*given)
    from dnnmso_mj.__main__ import main

    main()
