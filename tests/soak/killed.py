"""A run that is killed: how far it really was, and what its log holds of it."""

from __future__ import annotations

import mmap
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dnnmso_mj.errors import LogError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.reading import log_info, read_trace, recover
from dnnmso_mj.recording import ticks_in_a_block
from dnnmso_mj.run import run_logged
from dnnmso_mj.trace import Trace

BOUND_S = 0.1
CLOCKED = ("compute_us", "wake_late_us")  # columns of the wall clock
ENTRIES = 4096


class Page:
    """Memory that outlives its process: after which tick the loop was when, and nothing else."""

    def __init__(self, path: Path) -> None:
        if not path.exists():
            path.write_bytes(bytes(16 * ENTRIES + 16))
        with path.open("r+b") as file:
            self._entries = np.frombuffer(mmap.mmap(file.fileno(), 0), np.int64)

    def add(self, done: int) -> None:
        """Some more ticks are done."""
        count = int(self._entries[0])
        ticks = int(self._entries[2 * count]) if count else 0
        self._entries[2 * count + 2 : 2 * count + 4] = ticks + done, time.monotonic_ns()
        self._entries[0] = count + 1  # last, so that no half of an entry counts

    @property
    def entries(self) -> np.ndarray:
        """Ticks done, and when (ns): (m, 2)."""
        return self._entries[2 : 2 + 2 * int(self._entries[0])].reshape(-1, 2).copy()

    @property
    def ticks(self) -> int:
        """Done at the last report."""
        entries = self.entries
        return int(entries[-1, 0]) if len(entries) else 0


def run_reporting(
    sets: list[str], out: str, page: str, real_time: bool = False, force: bool = False
) -> None:
    """A logged run that says on a page how far it is."""
    shared = Page(Path(page))
    run_logged(
        load_scenario("paper", sets),
        Path(out),
        real_time=real_time,
        force=force,
        progress=shared.add,
    )


@dataclass(frozen=True)
class Loss:
    """What a kill has cost: simulated time, and for how long it had been done."""

    simulated_s: float
    wall_s: float


def loss(page: Page, held: int, killed_ns: int, dt: float, n_ticks: int, *, paced: bool) -> Loss:
    """What was done and is not held.

    A paced loop is where the clock is. Any other may be a whole block further than it has said.
    """
    entries = page.entries
    reported = page.ticks
    if paced:
        began = np.min(entries[:, 1] - entries[:, 0] * dt * 1e9) if len(entries) else killed_ns
        real = min(n_ticks, max(reported, int((killed_ns - began) / 1e9 / dt)))
    else:
        real = min(n_ticks, reported + ticks_in_a_block(dt, real_time=False))
    if held >= reported == n_ticks:
        return Loss(0.0, 0.0)
    before = entries[entries[:, 0] <= held]
    since = before[-1, 1] if len(before) else (entries[0, 1] if len(entries) else killed_ns)
    return Loss(max(0, real - held) * dt, max(0.0, (killed_ns - since) / 1e9))


def check_log(log: Path, reference: Trace, scratch: Path) -> int:
    """Read what is left of a log in every way; how many ticks it holds.

    Raises:
        AssertionError: a tick is not the undisturbed run's, or the ways differ.
    """
    info = log_info(log)
    if info.ticks == 0:
        try:
            read_trace(log)
        except LogError:
            return 0
        raise AssertionError("a log without a tick was read")
    trace = read_trace(log)
    check_ticks(trace, reference)
    assert info.ticks == len(trace), f"info says {info.ticks} ticks of {len(trace)}"
    whole = recover(log, scratch)
    scratch.unlink()
    assert whole.complete, "the recovered log is not whole"
    assert whole.ticks == len(trace), f"recovered {whole.ticks} ticks of {len(trace)}"
    return len(trace)


def check_ticks(trace: Trace, reference: Trace) -> None:
    """The ticks are the first of the reference, from 0 on, bit for bit.

    A deadline that was missed makes another run of what follows; the ticks before are compared.

    Raises:
        AssertionError: they are not.
    """
    count = len(trace)
    assert count <= len(reference), f"{count} ticks of {len(reference)}"
    assert (trace["t"] == reference["t"][:count]).all(), "ticks are missing or out of order"
    missed = np.flatnonzero(trace["deadline_missed"])
    alike = int(missed[0]) if missed.size else count
    for name in trace:
        if name not in CLOCKED:
            same = np.array_equal(trace[name][:alike], reference[name][:alike], equal_nan=True)
            assert same, f"{name} is not the undisturbed run's"


def wait_for(condition: Callable[[], bool], seconds: float = 30.0) -> bool:
    """Whether something comes about in that time."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(2e-4)
    return True
