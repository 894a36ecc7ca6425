"""Row 11, and that what it looks for is found: leaks, clocks that drift, runs kept in memory."""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from log_samples import LAYOUT, OK, recorder, rows
from soak.long_runs import check_times, repeat
from soak.proof import prove
from soak.resources import Sample, judge
from soak.tally import Tally


@pytest.fixture(autouse=True)
def own_temporary_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other processes make and remove theirs meanwhile."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def test_long_runs_and_many_runs_stay_flat(tmp_path: Path) -> None:
    prove(11, tmp_path, apart=True)


def found(errand: Callable[[], None], count: int = 30) -> Tally:
    """What the row says of something done again and again."""
    tally = Tally()
    judge(repeat(errand, count, 10), tally, unit="run", memory=1e-3, objects=0.5)
    return tally


@pytest.fixture
def kept() -> Iterator[list[object]]:
    """Things to hold on to, let go of afterwards."""
    out: list[object] = []
    yield out
    for thing in out:
        if isinstance(thing, int):
            os.close(thing)
        elif isinstance(thing, threading.Event):
            thing.set()


def test_what_leaks_nothing_is_flat() -> None:
    tally = found(lambda: None)
    assert (tally.lost, tally.survived) == ([], 8)


@pytest.mark.parametrize(
    ("leak", "said"),
    [
        (lambda kept, _: kept.append(np.ones(500_000)), "memory grows"),
        (lambda kept, _: kept.extend([] for _ in range(40)), "objects grows"),
        (lambda kept, folder: kept.append(os.open(folder, os.O_RDONLY)), "descriptors"),
        (lambda _, folder: tempfile.NamedTemporaryFile(dir=folder, delete=False).close(), "files"),
    ],
    ids=["memory", "objects", "descriptors", "files"],
)
def test_a_leak_is_lost(
    kept: list[object],
    tmp_path: Path,
    leak: Callable[[list[object], Path], None],
    said: str,
) -> None:
    tally = found(partial(leak, kept, tmp_path))
    assert any(lost.startswith(said) for lost in tally.lost), tally.lost


@pytest.mark.parametrize("when", range(6, 11))
def test_memory_that_an_allocator_takes_once_is_no_leak(when: int) -> None:
    """At any time of the runs that are judged."""
    tally = Tally()
    memory = [100.0 + 8.0 * (k >= when) for k in range(11)]
    samples = [Sample(3.0 * k, memory[k], 1000, 4, 2, 1, 0, 24, 12) for k in range(11)]
    judge(samples, tally, unit="run", memory=1e-3, objects=0.5)
    assert (tally.lost, tally.survived) == ([], 8)


def test_a_thread_that_stays_is_lost(kept: list[object]) -> None:
    def start() -> None:
        end = threading.Event()
        threading.Thread(target=end.wait, daemon=True).start()
        kept.append(end)

    tally = found(start, 20)
    assert {"threads", "enumerated"} <= {lost.partition(":")[0] for lost in tally.lost}


def log_of(path: Path, t: np.ndarray) -> Path:
    """A log whose rows have these times."""
    data = rows(len(t))
    data[:, LAYOUT.slices["t"]] = t[:, None]
    with recorder(path, duration=len(t) / 1000) as log:
        log.append(data)
        log.finish(OK)
    return path


def test_a_clock_that_is_added_up_is_noticed(tmp_path: Path) -> None:
    n_ticks = 2000
    assert check_times(log_of(tmp_path / "a.mcap", np.arange(n_ticks) * 0.001), 0.001) == n_ticks
    added_up = np.concatenate([[0.0], np.cumsum(np.full(n_ticks - 1, 0.001))])
    with pytest.raises(AssertionError, match=r"tick 10: t = 0\.010000000000000002"):
        check_times(log_of(tmp_path / "b.mcap", added_up), 0.001)
