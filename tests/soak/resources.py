"""What a process holds, sampled again and again, and whether it holds more and more."""

from __future__ import annotations

import gc
import os
import re
import sys
import tempfile
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from soak.tally import Tally

MIB = 1 << 20
WARM_UP = 0.5  # share of the samples that is left out: arenas and caches fill
NOISE_MIB = 4.0  # that an allocator may give or take, whatever is done


@dataclass(frozen=True)
class Sample:
    """What a process holds.

    Args:
        done: what has been done so far: runs, or seconds.
        memory: MiB of its own (not of files).
        objects: that Python's garbage collector knows.
        descriptors, threads: open; threads as the kernel counts them.
        enumerated: threads as Python does.
        files: in its folder for temporary files.
        compiled: signatures of numba's functions.
        cached: entries of `functools` caches.
    """

    done: float
    memory: float
    objects: int
    descriptors: int
    threads: int
    enumerated: int
    files: int
    compiled: int
    cached: int


COUNTED = ("descriptors", "threads", "enumerated", "files", "compiled", "cached")


def sample(done: float) -> Sample:
    """Sample this process, after what nobody holds any more has been freed."""
    gc.collect()
    return Sample(
        done,
        own_memory() / MIB,
        len(gc.get_objects()),
        len(os.listdir("/proc/self/fd")),
        len(os.listdir("/proc/self/task")),
        threading.active_count(),
        sum(1 for _ in Path(tempfile.gettempdir()).rglob("*")),
        *_caches(),
    )


def own_memory() -> int:
    """Bytes of this process that are no file's."""
    return _status("RssAnon")


def resident_memory() -> int:
    """Bytes of this process in memory, those of files too."""
    return _status("VmRSS")


def peak_memory() -> int:
    """The most bytes that this process had at once since `forget_peak`, those of files too."""
    return _status("VmHWM")


def forget_peak() -> None:
    """Begin the peak anew."""
    Path("/proc/self/clear_refs").write_text("5")


def _status(name: str) -> int:
    found = re.search(rf"{name}:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) * 1024


def _caches() -> tuple[int, int]:
    """Signatures compiled, and entries cached, of all functions of the package."""
    compiled = cached = 0
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] != "dnnmso_mj":
            continue
        for value in list(vars(module).values()):
            compiled += len(getattr(value, "overloads", ()))
            if info := getattr(value, "cache_info", None):
                cached += info().currsize
    return compiled, cached


def slope(samples: Sequence[Sample], name: str) -> float:
    """By how much a quantity grows with what is done, after the warm-up."""
    return _slope(_late(samples), name)


def _slope(samples: Sequence[Sample], name: str) -> float:
    done, values = ([getattr(each, key) for each in samples] for key in ("done", name))
    return float(np.polyfit(done, values, 1)[0]) if len(samples) > 1 else 0.0


def judge(
    samples: Sequence[Sample], tally: Tally, *, unit: str, memory: float, objects: float
) -> None:
    """Count what is flat as survived, and what grows as lost.

    Args:
        samples: in their order.
        tally: where they are counted.
        unit: what `done` counts.
        memory: MiB that may be held more for each unit.
        objects: the same of Python's objects.
    """
    late = _late(samples)
    span = late[-1].done - late[0].done
    bounds = {"memory": (memory, NOISE_MIB), "objects": (objects, 200.0)}
    for name, (allowed, noise) in bounds.items():
        # What leaks goes on leaking; an allocator takes a step, once.
        grows = min(_slope(half, name) for half in (late[: len(late) // 2], late[len(late) // 2 :]))
        if grows > allowed and grows * span > noise:
            tally.lose(f"{name} grows by {grows:.3g} per {unit} over {span:g}; allowed {allowed:g}")
        else:
            tally.survive()
    for name in COUNTED:
        first, last = (getattr(each, name) for each in (late[0], late[-1]))
        if last > first:
            tally.lose(f"{name}: {first} became {last} over {span:g} {unit}s")
        else:
            tally.survive()


def _late(samples: Sequence[Sample]) -> Sequence[Sample]:
    return samples[int(WARM_UP * len(samples)) :]


def described(first: Sample, last: Sample) -> dict[str, Any]:
    """Two samples side by side, for the scorecard."""
    return {name: f"{getattr(first, name)} → {getattr(last, name)}" for name in COUNTED}
