"""What keeps a run from its machine: load, bursts above its priority, stops."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

SPIN = "while True: pass"
MEMORY = """
import itertools
for n in itertools.count():
    block = bytearray(128 * 2**20)
    for i in range(0, len(block), 4096): block[i] = n % 256
"""
DISK = """
import os, sys
while True:
    with open(sys.argv[1], "wb") as file:
        for _ in range(16):
            file.write(os.urandom(2**20)); file.flush(); os.fsync(file.fileno())
"""
BURST = """
import os, sys, time
core, ms = int(sys.argv[1]), float(sys.argv[2])
os.sched_setaffinity(0, {core})
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(60))
print("ready", flush=True)
at = int(sys.stdin.readline())
while (left := at - time.monotonic_ns()) > 0: time.sleep(left / 2e9)
begin = now = time.monotonic_ns()
while now < begin + ms * 1e6: now = time.monotonic_ns()
print(begin, now)
"""
_DROP_FROM_BOUNDS, _SYS_NICE = 24, 23  # PR_CAPBSET_DROP, CAP_SYS_NICE


def give_up_priority() -> None:
    """Leave the program that this process becomes no better priority than everybody's."""
    ctypes.CDLL(None).prctl(_DROP_FROM_BOUNDS, _SYS_NICE, 0, 0, 0)


@contextmanager
def load(folder: Path) -> Iterator[None]:
    """Two busy processes a core, and one each for memory and disk, of ordinary priority."""
    programs = [[SPIN]] * (2 * len(os.sched_getaffinity(0)))
    programs += [[MEMORY], [DISK, str(folder / "pressure.bin")]]
    running = [
        subprocess.Popen([sys.executable, "-c", *words], start_new_session=True)
        for words in programs
    ]
    try:
        yield
    finally:
        for process in running:
            process.kill()
        for process in running:
            process.wait()


def burst(ms: float) -> tuple[int, int]:
    """Take every core for so long, above any run's priority: from when to when all were taken."""
    running = [
        subprocess.Popen(
            [sys.executable, "-c", BURST, str(core), str(ms)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for core in sorted(os.sched_getaffinity(0))
    ]
    for process in running:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    at = time.monotonic_ns() + 20_000_000
    for process in running:
        assert process.stdin is not None
        process.stdin.write(f"{at}\n")
        process.stdin.flush()
    said = [process.communicate(timeout=30)[0].split() for process in running]
    times = [(int(begin), int(end)) for begin, end in said]
    return max(begin for begin, _ in times), min(end for _, end in times)


def can_burst() -> bool:
    """Whether this process may take cores from a run of real-time priority."""
    before, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(60))
    except OSError:
        return False
    os.sched_setscheduler(0, before, parameters)
    return True


def stop(pid: int, seconds: float) -> tuple[int, int]:
    """Stop a process for a while: from when to when it surely stood still."""
    os.kill(pid, signal.SIGSTOP)
    try:
        until = time.monotonic() + 5
        while _state(pid) != "T" and time.monotonic() < until:
            time.sleep(1e-4)
        begin = time.monotonic_ns()
        time.sleep(seconds)
        end = time.monotonic_ns()
    finally:
        os.kill(pid, signal.SIGCONT)
    return begin, end


def _state(pid: int) -> str:
    tasks = Path(f"/proc/{pid}/task").glob("*/stat")
    states = {task.read_text().rpartition(")")[2].split()[0] for task in tasks}
    return "T" if states == {"T"} else "-"
