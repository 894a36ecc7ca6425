"""A finished run: its rows are read when they are asked for, and metrics do not need them all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dnnmso_mj import load_scenario, logged, metrics
from dnnmso_mj.errors import LogError
from dnnmso_mj.logged import judge, read_drawn
from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.plots import run_figures
from dnnmso_mj.reading import log_info, read_trace
from dnnmso_mj.run import run_logged
from dnnmso_mj.sweep.task import Task, run_task
from dnnmso_mj.trace import RunInfo, StepLayout

PD = ["controller={kind: pd}", "duration=0.5"]


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


def test_figures_of_an_outline_say_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logged, "BLOCK", 64)
    monkeypatch.setattr(logged, "OUTLINE_BUCKETS", 5)
    done = run_logged(load_scenario("paper", PD), tmp_path / "run.mcap")
    for trace, said in (
        (done.drawn(), f"outlined by {len(done.drawn())} of 500 ticks"),
        (done.trace, ""),
    ):
        title = run_figures(trace)["error"].get_suptitle()
        assert said in title
        assert ("outlined" in title) == bool(said)
    assert len(read_drawn(done.log)) == len(done.drawn())


def test_a_log_that_lacks_what_it_was_given_is_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = run_logged(load_scenario("paper", PD), tmp_path / "run.mcap")
    layout = StepLayout(2, 0)
    for block in (64, 65_536):
        monkeypatch.setattr(logged, "BLOCK", block)
        same = judge(done.log, done.scenario, layout, done.info, 500)
        assert (same.ticks, same.info.status) == (500, "ok")
        with pytest.raises(LogError, match="holds 500 ticks of 501 that it was given"):
            judge(done.log, done.scenario, layout, done.info, 501)


def test_a_run_that_ended_before_its_first_tick_has_an_empty_trace(tmp_path: Path) -> None:
    scenario = load_scenario("paper", PD)
    info = RunInfo("diverged", scenario.seed, reason="q = [nan, 0.0] at t = 0 s")
    layout = StepLayout(scenario.n_joints, 0)
    done = judge(tmp_path / "run.mcap", scenario, layout, info, 0)
    assert len(done.trace) == len(done.drawn()) == done.ticks == 0
    assert done.trace.info.reason == info.reason
