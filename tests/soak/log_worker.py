"""Reads logs as every command does, each in a forked child that tells what it found and cost.

As a program: log_worker.py ORIGINAL, then on standard input a line of JSON for each log.
"""

from __future__ import annotations

import json
import os
import resource
import select
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dnnmso_mj.difference import difference
from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.logged import read_drawn
from dnnmso_mj.reading import log_info, read_snapshots, read_trace, recover
from dnnmso_mj.recorded import read_recorded
from dnnmso_mj.trace import Trace

HANGS = 60.0  # s of wall time after which a child is killed


def rows_of(trace: Trace) -> dict[str, bytes]:
    """Every column's bits."""
    return {name: np.ascontiguousarray(trace[name]).tobytes() for name in trace}


class Original:
    """A good log, and what a damaged copy of it may say."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.trace, self.info = read_trace(path), log_info(path)
        self.rows = rows_of(self.trace)
        self.snapshots = read_snapshots(path)

    def check_trace(self, trace: Trace, whole: bool) -> None:
        """A true prefix; and only the whole log ends well."""
        for name, bits in rows_of(trace).items():
            assert self.rows[name].startswith(bits), f"{name} is not the original's"
            assert len(bits) * len(self.trace) == len(self.rows[name]) * len(trace), name
        assert trace.events == self.trace.events[: len(trace.events)], "other events"
        assert whole == (trace.info.status != "unfinished"), f"status {trace.info.status}"

    def check_snapshots(self, found: list[Any], whole: bool) -> None:
        """The first ones, bit for bit."""
        assert whole <= (len(found) == len(self.snapshots)), "snapshots are missing"
        for one, other in zip(found, self.snapshots, strict=False):
            assert (one.name, one.t, one.arrays.keys()) == (
                other.name,
                other.t,
                other.arrays.keys(),
            )
            for key, array in one.arrays.items():
                assert array.tobytes() == other.arrays[key].tobytes(), f"snapshot {one.name}"


def readers(path: Path, original: Original, kind: str) -> dict[str, Callable[[], None]]:
    """Every reader, with what must hold of what it gives.

    Args:
        path: of the log.
        original: what it is a copy of.
        kind: "damaged"; "whole" if it is not; "made" if it is no copy at all.
    """
    own, whole = kind != "made", kind == "whole"

    def trace(read: Callable[[Path], Trace]) -> Callable[[], None]:
        def check() -> None:
            found = read(path)
            if own:
                original.check_trace(found, whole)

        return check

    def info() -> None:
        found = log_info(path)
        assert not own or found.complete == whole, f"complete: {found.complete}"
        assert not own or found.ticks <= original.info.ticks

    def snapshots() -> None:
        found = read_snapshots(path)
        if own:
            original.check_snapshots(found, whole)

    def recovered() -> None:
        out = Path(f"{path}.{os.getpid()}.recovered")
        try:
            found = recover(path, out)
            assert found.complete, "what was recovered is not complete"
            if own and found.ticks:
                original.check_trace(read_trace(out), whole)
        finally:
            out.unlink(missing_ok=True)

    def diff() -> None:
        found = difference(path, original.path)
        if own:
            assert not found.columns, f"differs in {found.columns[0].name}"
            assert found.equal == whole, f"equal: {found.equal}"

    return {
        "read_trace": trace(read_trace),
        "log_info": info,
        "read_snapshots": snapshots,
        "recover": recovered,
        "diff": diff,
        "resume": trace(lambda log: read_recorded(log).trace),
        "plot": trace(read_drawn),
    }


def attempt(path: Path, original: Original, kind: str) -> dict[str, Any]:
    """What every reader made of a log; problems in words, CPU seconds, and the peak of memory."""
    problems, seconds, refused = [], {}, 0
    for name, read in readers(path, original, kind).items():
        before = time.process_time()
        try:
            read()
        except DnnmsoError as error:
            refused += 1
            if not str(error) or "\n" in str(error) or len(str(error)) > 2000:
                problems.append(f"{name}: a message of {len(str(error))} characters")
        except BaseException as error:
            problems.append(f"{name}: {type(error).__name__}: {str(error)[:200]}")
        seconds[name] = time.process_time() - before
    status = Path("/proc/self/status").read_text()
    peak = next(line for line in status.splitlines() if line.startswith("VmHWM"))
    return {
        "problems": problems,
        "seconds": seconds,
        "refused": refused,
        "peak": int(peak.split()[1]) * 1024,
    }


def apart(path: Path, original: Original, kind: str) -> dict[str, Any]:
    """`attempt` in a child."""
    ours, theirs = os.pipe()
    child = os.fork()
    if not child:
        os.close(ours)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        try:
            os.write(theirs, json.dumps(attempt(path, original, kind)).encode())
        finally:
            os._exit(0)
    os.close(theirs)
    ready, _, _ = select.select([ours], [], [], HANGS)
    said = os.read(ours, 1 << 16) if ready else b""
    os.close(ours)
    if not ready:
        os.kill(child, signal.SIGKILL)
    status = os.waitpid(child, 0)[1]
    if said:
        found: dict[str, Any] = json.loads(said)
        return found
    why = f"ended by signal {os.WTERMSIG(status)}" if ready else f"hangs after {HANGS:g} s"
    return {"problems": [why], "seconds": {}, "refused": 0, "peak": 0}


def main() -> None:
    """Answer each line with one."""
    original = Original(Path(sys.argv[1]))
    print("ready", flush=True)
    for line in sys.stdin:
        path, kind = json.loads(line)
        print(json.dumps(apart(Path(os.fsdecode(bytes.fromhex(path))), original, kind)), flush=True)


if __name__ == "__main__":
    main()
