"""Row 4 in short, and that its checkers see what is broken."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from soak.killed import BOUND_S, Page, check_log, check_ticks, loss
from soak.killed_sweeps import Reporter, check_rows
from soak.kills import many
from soak.proof import prove
from soak.tally import Tally
from sweep_samples import children

from dnnmso_mj.loading import load_scenario
from dnnmso_mj.run import run_logged
from dnnmso_mj.sweep.journal import journal_path
from dnnmso_mj.sweep.local import LocalEngine
from dnnmso_mj.sweep.plan import plan_sweep


@pytest.mark.alone
def test_sigkill_at_any_instant_costs_at_most_a_tenth_of_a_second(tmp_path):
    prove(4, tmp_path)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    log = tmp_path_factory.mktemp("log") / "run.mcap"
    return run_logged(load_scenario("paper", ["duration=0.4"]), log)


def test_a_log_that_is_cut_is_a_prefix(done, tmp_path):
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(done.log.read_bytes()[: done.log.stat().st_size // 2])
    assert 0 < check_log(torn, done.trace, tmp_path / "again.mcap") < len(done.trace)


def test_a_log_with_a_hole_is_no_prefix(done):
    columns = {name: np.delete(values, 100, axis=0) for name, values in done.trace.columns.items()}
    with pytest.raises(AssertionError, match="missing or out of order"):
        check_ticks(replace(done.trace, columns=columns), done.trace)


def test_one_bit_more_is_another_run(done):
    columns = {name: values.copy() for name, values in done.trace.columns.items()}
    columns["q"][77, 0] = np.nextafter(columns["q"][77, 0], 9.0)
    with pytest.raises(AssertionError, match="q is not the undisturbed run's"):
        check_ticks(replace(done.trace, columns=columns), done.trace)


def test_what_follows_a_missed_deadline_is_not_compared(done):
    columns = {name: values.copy() for name, values in done.trace.columns.items()}
    columns["deadline_missed"][50] = 1.0
    columns["q"][51:] += 1.0
    check_ticks(replace(done.trace, columns=columns), done.trace)


def test_a_frozen_log_is_lost(tmp_path):
    page = Page(tmp_path / "page")
    for _ in range(20):
        page.add(50)
    cost = loss(page, 700, time.monotonic_ns(), 1e-3, 10_000, paced=False)
    assert cost.simulated_s == pytest.approx(0.34)  # 300 ticks, and the block under way

    tally = Tally()
    many(tally, tmp_path, 0, "a run", lambda _place, _rng: cost, 1)
    assert tally.lost == ["a run 0, seed 0: AssertionError: 0.340 s are lost"]


def test_a_paced_run_is_where_the_clock_is(tmp_path):
    page = Page(tmp_path / "page")
    page.add(20)
    time.sleep(0.15)
    cost = loss(page, 20, time.monotonic_ns(), 1e-3, 1000, paced=True)
    assert cost.simulated_s > BOUND_S
    assert loss(page, 1000, time.monotonic_ns(), 1e-3, 1000, paced=True).simulated_s == 0.0


def test_a_row_that_was_called_safe_and_is_not_there_is_lost(tmp_path):
    out, told = tmp_path / "sweep.parquet", tmp_path / "told"
    reporter = Reporter(told)
    for seed in range(3):
        reporter.row({"point": 0, "seed": seed})
    rows = [{"points": []}, *({"point": 0, "seed": seed} for seed in range(2))]
    journal_path(out).write_text("".join(f"{json.dumps(row)}\n" for row in rows))
    with pytest.raises(AssertionError, match="1 of 3 finished rows are lost"):
        check_rows(out, told)
    journal_path(out).unlink()
    with pytest.raises(AssertionError, match="3 of 3 finished rows are lost"):
        check_rows(out, told)


def test_a_worker_that_is_killed_before_it_is_ready_is_started_once_more():
    plan = plan_sweep("paper", range(2), ["duration=0.05"])
    killed = []

    def end_one() -> None:
        workers = [pid for pid in children(os.getpid()) if pid not in others]
        if not workers:  # none is started yet
            threading.Timer(0.01, end_one).start()
            return
        os.kill(workers[-1], signal.SIGKILL)
        killed.append(workers[-1])

    others = set(children(os.getpid()))
    threading.Timer(0.0, end_one).start()
    rows = list(LocalEngine(1).rows(plan.tasks([set()])))
    assert len(killed) == 1
    assert sorted(row["seed"] for row in rows) == [0, 1]
    assert {row["status"] for row in rows} == {"ok"}
