"""A command of ours in a process of its own: how it ended, in what time and memory."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

# Peak memory is asked of the process itself: what wait4 says of a child counts its parent's too.
LAUNCH = """
import atexit, os, sys
out = sys.argv.pop(1)
def note():
    with open("/proc/self/status") as status, open(out, "w") as file:
        file.write(next(line for line in status if line.startswith("VmHWM")))
atexit.register(note)
from dnnmso_mj.__main__ import main
main()
"""


@dataclass(frozen=True)
class Ended:
    """How a command ended.

    Args:
        status: as it exited; below zero: a signal's number; None: it was killed after its time.
        out, err: what it printed.
        seconds: wall time.
        peak_bytes: of its memory; None where it could not say any more.
    """

    status: int | None
    out: str
    err: str
    seconds: float
    peak_bytes: int | None

    @property
    def is_one_error(self) -> bool:
        """Refused as a person expects: status 2, `error: …`, and no traceback."""
        return self.status == 2 and "error: " in self.err and "Traceback" not in self.err


def dnnmso(
    *arguments: str | Path,
    seconds: float = 60.0,
    cwd: Path | None = None,
    env: Mapping[str, str] | None = None,
) -> Ended:
    """Run `dnnmso ARGUMENTS`, for at most so many seconds."""
    with tempfile.NamedTemporaryFile(prefix="dnnmso-peak-") as peak:
        words = [sys.executable, "-c", LAUNCH, peak.name, *map(str, arguments)]
        ended = _run(words, seconds, cwd, os.environ | dict(env or {}))
        found = re.search(r"VmHWM:\s+(\d+) kB", Path(peak.name).read_text())
    status, out, err, took = ended
    return Ended(status, out, err, took, int(found[1]) * 1024 if found else None)


def _run(
    words: Sequence[str], seconds: float, cwd: Path | None, env: Mapping[str, str]
) -> tuple[int | None, str, str, float]:
    started = time.monotonic()
    process = subprocess.Popen(
        words,
        cwd=cwd,
        env=env,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
    )
    status: int | None
    try:
        out, err = process.communicate(timeout=seconds)
        status = process.returncode
    except subprocess.TimeoutExpired:
        process.kill()
        out, err = process.communicate()
        status = None
    return status, out, err, time.monotonic() - started
