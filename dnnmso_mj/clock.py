"""The machine's clock for compiled code: read it, and sleep to an absolute time."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types
from numba.core.types import ExternalFunction

from dnnmso_mj.compiling import compiled

Array = np.ndarray

MONOTONIC, ABSOLUTE = 1, 1  # CLOCK_MONOTONIC and TIMER_ABSTIME of Linux's <time.h>
SPIN_NS = 150_000  # the last stretch is waited awake: a sleeper is woken up to this late

_gettime: Any = ExternalFunction("clock_gettime", types.int32(types.int32, types.intp))
_nanosleep: Any = ExternalFunction(
    "clock_nanosleep", types.int32(types.int32, types.int32, types.intp, types.intp)
)


@compiled
def now_ns(timespec: Array) -> int:
    """Monotonic time (ns), as Python's `time.monotonic_ns`; timespec (2,) int64 is scratch."""
    _gettime(MONOTONIC, timespec.ctypes.data)
    return int(timespec[0]) * 1_000_000_000 + int(timespec[1])


@compiled
def sleep_until(due: int, timespec: Array) -> int:
    """Return at monotonic time `due` (ns), or at once when it is past; the time then (ns)."""
    now = now_ns(timespec)
    while due - now > SPIN_NS:
        until = due - SPIN_NS
        timespec[0], timespec[1] = until // 1_000_000_000, until % 1_000_000_000
        _nanosleep(MONOTONIC, ABSOLUTE, timespec.ctypes.data, 0)
        now = now_ns(timespec)
    while now < due:
        now = now_ns(timespec)
    return now
