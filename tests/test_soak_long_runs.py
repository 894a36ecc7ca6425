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
from soak.resources import judge
from soak.tally import Tally

from dnnmso_mj import load_scenario, logged, metrics
from dnnmso_mj.errors import LogError
from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.reading import log_info, read_trace
from dnnmso_mj.run import run_logged
from dnnmso_mj.sweep.task import Task, run_task

PD = ["controller={kind: pd}", "duration=0.5"]


@pytest.fixture(autouse=True)
def own_temporary_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other processes make and remove theirs meanwhile."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def test_long_runs_and_many_runs_stay_flat(tmp_path: Path) -> None:
    prove(11, tmp_path)


def found(errand: Callable[[], None], count: int = 60) -> Tally:
    """What the row says of something done again and again."""
    tally = Tally()
    judge(repeat(errand, count, 20), tally, unit="run", memory=1e-3, objects=0.5)
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
        (lambda kept, _: kept.append(np.ones(50_000)), "memory grows"),
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


def test_a_thread_that_stays_is_lost(kept: list[object]) -> None:
    def start() -> None:
        end = threading.Event()
        threading.Thread(target=end.wait, daemon=True).start()
        kept.append(end)

    tally = found(start, 40)
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


def test_a_long_run_has_the_metrics_of_its_trace_and_of_a_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Blocks of 64 ticks make every run a long one."""
    monkeypatch.setattr(metrics, "BLOCK", 64)
    monkeypatch.setattr(logged, "BLOCK", 64)
    scenario = load_scenario("paper", PD)
    done = run_logged(scenario, tmp_path / "run.mcap")
    assert done.kept is None
    assert done.info.metrics == compute_metrics(read_trace(done.log)) == log_info(done.log).metrics
    mjcf = Mjcf.read(find_model(scenario.plant.model))
    (row,) = run_task(Task(0, scenario, mjcf, (scenario.seed,)))
    clocked = {"compute_us_p50", "compute_us_p999"}
    assert {name: row[name] for name in done.info.metrics if name not in clocked} == {
        name: value for name, value in done.info.metrics.items() if name not in clocked
    }


def test_blocks_change_a_metric_by_its_rounding_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    from dnnmso_mj import simulate

    trace = simulate(load_scenario("paper", PD))
    whole = compute_metrics(trace)
    for ticks in (1, 2, 63, 249, 250, 251, 499, 500):
        monkeypatch.setattr(metrics, "BLOCK", ticks)
        for name, value in compute_metrics(trace).items():
            expected = value if value is None else pytest.approx(whole[name], rel=1e-13)
            assert value == expected, (ticks, name)


def test_the_trace_of_a_long_run_is_read_when_it_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logged, "BLOCK", 64)
    done = run_logged(load_scenario("paper", PD), tmp_path / "run.mcap")
    trace = read_trace(done.log)
    assert len(done.trace) == done.ticks == 500
    assert done.trace.info == done.info == trace.info
    part = done.part("t", "compute_us")
    assert list(part) == ["t", "compute_us"]
    assert all(np.array_equal(part[name], trace[name]) for name in part)
    other = run_logged(load_scenario("paper", PD), tmp_path / "run.mcap", force=True)
    with pytest.raises(LogError, match="is another run's by now"):
        done.drawn()
    assert len(other.drawn()) <= 500


def test_an_outline_has_every_extreme_of_what_is_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logged, "BLOCK", 64)
    monkeypatch.setattr(logged, "OUTLINE_BUCKETS", 5)
    done = run_logged(load_scenario("paper", ["duration=2.0"]), tmp_path / "run.mcap")
    outline, trace = done.drawn(), done.trace
    assert len(outline) < len(trace) / 2
    assert (outline["t"][0], outline["t"][-1]) == (trace["t"][0], trace["t"][-1])
    ticks = np.rint(outline["t"] * 1000).astype(int)
    for name in set(trace) - {"drt_bound"}:
        assert np.array_equal(outline[name], trace[name][ticks]), name
    for first in range(0, 2000, 400):
        bucket, kept = slice(first, first + 400), (ticks >= first) & (ticks < first + 400)
        for name in ("tau", "f_hat", "weight_norm", "compute_us", "lyapunov"):
            assert np.array_equal(outline[name][kept].max(axis=0), trace[name][bucket].max(axis=0))
            assert np.array_equal(outline[name][kept].min(axis=0), trace[name][bucket].min(axis=0))


def test_an_outline_shows_no_bound_over_the_change_of_another_tick(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The gradient's change is sampled and held: its bound in an outline is that of its sample."""
    monkeypatch.setattr(logged, "BLOCK", 64)
    done = run_logged(load_scenario("paper", ["duration=2.0"]), tmp_path / "run.mcap")
    outline, trace = done.drawn(), done.trace
    change = trace["gradient_change"]
    fresh = np.any(np.diff(change, axis=0, prepend=0.0) != 0.0, axis=1)
    pairs = {change[k].tobytes(): trace["drt_bound"][k] for k in np.flatnonzero(fresh)}
    assert len(pairs) > 10
    for measured, bound in zip(outline["gradient_change"], outline["drt_bound"], strict=True):
        assert measured.any() <= (bound == pairs.get(measured.tobytes()))
