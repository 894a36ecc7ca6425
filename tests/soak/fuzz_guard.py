"""Around a target that is fuzzed: what it may raise, in which time and memory; all else is kept."""

from __future__ import annotations

import base64
import mmap
import os
import struct
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from dnnmso_mj.errors import DnnmsoError

MAX_S = 1.0
MAX_BYTES = 256 * 2**20
AGAIN = 2  # times that a slow case is tried once more: on a busy machine it may not be its fault
KEPT = 100_000  # bytes of an input
_HEAD = struct.Struct("<QQ")  # cases so far, and the length of the input that is tried now

Target = Callable[[bytes], None]


@dataclass
class Failure:
    """Cases that failed in the same way.

    Args:
        what: the way.
        input: the shortest of them, base64.
        cases: how many.
    """

    what: str
    input: str
    cases: int = 0


@dataclass
class Found:
    """What some cases came to."""

    cases: int = 0
    accepted: int = 0
    refused: int = 0
    slowest_s: float = 0.0
    largest_mb: float = 0.0
    failures: dict[str, Failure] = field(default_factory=dict)

    @property
    def lost(self) -> int:
        """Cases that failed."""
        return self.cases - self.accepted - self.refused

    def as_json(self) -> dict[str, Any]:
        """As `from_json` takes it."""
        return asdict(self)

    @classmethod
    def from_json(cls, said: dict[str, Any]) -> Found:
        """Undo `as_json`."""
        failures = {key: Failure(**failure) for key, failure in said["failures"].items()}
        return cls(**{**said, "failures": failures})


class Guard:
    """Tries a target on inputs, and counts.

    Memory is the growth of what is resident, from just before a case to its peak: the kernel's own
    high-water mark, put back before each case. Time is by the clock, less what others had the core
    for; a case over its time is tried again, and the shortest time counts.

    Args:
        target: returns, or raises a `DnnmsoError`.
        note: a file that always holds the input that is tried now; see `tried_now`.
    """

    def __init__(self, target: Target, note: Path) -> None:
        self.found = Found()
        self._target = target
        note.write_bytes(bytes(_HEAD.size + KEPT))
        with note.open("r+b") as file:
            self._note = mmap.mmap(file.fileno(), 0)
        self._memory = Memory()
        self._scheduler = os.open("/proc/thread-self/schedstat", os.O_RDONLY)

    def __call__(self, data: bytes) -> None:
        """One case."""
        found = self.found
        found.cases += 1
        kept = data[:KEPT]
        self._note[: _HEAD.size + len(kept)] = _HEAD.pack(found.cases, len(kept)) + kept
        self._memory.begin()
        seconds, refused, why = self._timed(data)
        grown = self._memory.grown()
        for _ in range(AGAIN):
            if seconds > MAX_S:
                seconds = min(seconds, self._timed(data)[0])
        found.slowest_s = max(found.slowest_s, seconds)
        found.largest_mb = max(found.largest_mb, grown / 2**20)
        if seconds > MAX_S:
            why["slow"] = f"took {seconds:.2f} s"
        if grown > MAX_BYTES:
            why["large"] = f"took {grown / 2**20:.0f} MB"
        found.refused += refused and not why
        found.accepted += not (refused or why)
        for key, what in why.items():
            self._keep(key, what, data)

    def _timed(self, data: bytes) -> tuple[float, bool, dict[str, str]]:
        """Seconds, whether it was refused, and in which way it failed, if it did."""
        started, refused, why = self._clock(), False, {}
        try:
            self._target(data)
        except DnnmsoError as error:
            refused, text = True, str(error)
            if not text.strip() or not _is_printable(text):
                why["message"] = f"the message {text!r:.100} cannot be printed"
        except Exception as error:
            why[_place(error)] = f"{type(error).__name__}: {str(error)[:200]!r}"
        return self._clock() - started, refused, why

    def _clock(self) -> float:
        """Seconds in which this thread ran, or waited for anything but a free core."""
        waited = os.pread(self._scheduler, 100, 0).split()[1]
        return time.perf_counter() - int(waited) / 1e9

    def _keep(self, key: str, what: str, data: bytes) -> None:
        encoded = base64.b64encode(data[:KEPT]).decode()
        failure = self.found.failures.setdefault(key, Failure(f"{key}: {what}", encoded))
        failure.cases += 1
        failure.input = min(failure.input, encoded, key=len)


def tried_now(note: Path) -> tuple[int, bytes]:
    """How many cases a guard has begun, and the input of the last."""
    data = note.read_bytes()
    cases, length = _HEAD.unpack_from(data)
    return cases, data[_HEAD.size : _HEAD.size + length]


class Memory:
    """How much more memory is resident than before, at most."""

    def __init__(self) -> None:
        self._status = os.open("/proc/self/status", os.O_RDONLY)
        self._reset = os.open("/proc/self/clear_refs", os.O_WRONLY)
        self._before = 0

    def begin(self) -> None:
        """From here on."""
        os.pwrite(self._reset, b"5", 0)  # the high-water mark falls to what there is now
        self._before = self._peak()

    def grown(self) -> int:
        """Bytes, up to here."""
        return self._peak() - self._before

    def _peak(self) -> int:
        status = os.pread(self._status, 4096, 0)
        start = status.index(b"VmHWM:") + 6
        return int(status[start : status.index(b"kB", start)]) * 1024


def _place(error: BaseException) -> str:
    """The line of code that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    last = frames[-1]
    return f"{Path(last.filename).name}:{last.lineno} {type(error).__name__}"


def _is_printable(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True
