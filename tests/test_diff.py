"""Comparing two logs: what is told, what is counted, and the exit status."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from log_samples import LAYOUT, OK, append_all, recorder, rows

from dnnmso_mj.difference import difference, rows_differ
from dnnmso_mj.errors import LogError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.run import run_logged
from dnnmso_mj.trace import Event, RunInfo, StepLayout

COLUMN = LAYOUT.slices


def changed(folder: Path, *changes: tuple[str, int, int, float], count: int = 230) -> Path:
    """A log of which numbers are others: (column, tick, entry, by how much)."""
    data = rows(count)
    for name, tick, entry, by in changes:
        data[tick, COLUMN[name].start + entry] += by
    log = folder / f"changed-{len(list(folder.iterdir()))}.mcap"
    append_all(log, data)
    return log


def diff(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "dnnmso_mj", "diff", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_two_logs_of_the_same_run_are_equal_and_the_wall_clock_is_told_apart(tmp_path):
    one = changed(tmp_path)
    other = changed(tmp_path, ("compute_us", 7, 0, 1.0), ("wake_late_us", 9, 0, 2.0))
    found = difference(one, other)
    assert found.equal
    assert not found.columns
    assert {(c.name, c.first.tick) for c in found.clocked} == {
        ("compute_us", 7),
        ("wake_late_us", 9),
    }


def test_where_each_column_first_differs_and_where_the_most_is_told(tmp_path):
    changes = [("q", 40, 1, 1e-3), ("q", 90, 0, -0.5), ("tau", 12, 0, 2.0), ("q", 200, 0, 0.1)]
    one, other = changed(tmp_path), changed(tmp_path, *changes)
    found = difference(one, other)
    tau, q = found.columns  # the first to differ comes first
    assert (tau.name, q.name) == ("tau", "q")
    assert (tau.first.tick, tau.first.entry, tau.first.t) == (12, 0, 0.012)
    assert tau.first.values == (
        rows(230)[12, COLUMN["tau"].start],
        rows(230)[12, COLUMN["tau"].start] + 2.0,
    )
    assert (q.first.tick, q.first.entry) == (40, 1)
    assert q.first.difference == pytest.approx(1e-3)
    assert (q.largest.tick, q.largest.entry) == (90, 0)
    assert q.largest.difference == pytest.approx(0.5)
    assert not found.equal


def test_one_bit_is_a_difference():
    one = np.array([[0.1 + 0.2, 1.0], [0.0, np.nan]])
    other = np.array([[0.3, 1.0], [0.0, np.nan]])
    assert rows_differ(one, other).tolist() == [True, False]
    assert rows_differ(np.array([0.0]), np.array([-0.0])).tolist() == [True]


def test_a_shorter_log_differs_and_what_both_have_is_compared(tmp_path):
    one, other = changed(tmp_path), changed(tmp_path, count=200)
    found = difference(one, other)
    assert found.ticks == (230, 200)
    assert not found.columns
    assert not found.equal


def test_scenario_status_events_and_snapshots_count(tmp_path):
    one, other = tmp_path / "one.mcap", tmp_path / "other.mcap"
    with recorder(one) as log:
        log.append(rows(50))
        log.event(Event(0.01, "info", "both"))
        log.event(Event(0.02, "info", "one alone"))
        log.snapshot("net", 0.0, {"W": np.zeros(3), "same": np.ones(2)})
        log.snapshot("net", 0.03, {})
        log.finish(OK)
    with recorder(other, seed=8, plant={"gravity": 1.62}) as log:
        log.append(rows(50))
        log.event(Event(0.01, "info", "both"))
        log.event(Event(0.01, "info", "both"))
        log.snapshot("net", 0.0, {"W": np.array([0.0, 0.0, 0.5]), "same": np.ones(2)})
        log.finish(RunInfo(status="diverged", seed=8, reason="why"))
    found = difference(one, other)
    assert found.scenario == {"seed": (7, 8), "plant.gravity": (9.81, 1.62)}
    assert found.status == ("ok", "diverged why")
    assert found.events == (("0.02 s: info: one alone",), ("0.01 s: info: both",))
    assert found.snapshots == (
        "net at 0 s: W by up to 0.5",
        "net at 0.03 s: in the first log alone",
    )
    assert not found.columns


def test_columns_of_other_widths_are_told_and_the_rest_compared(tmp_path):
    one, other = tmp_path / "one.mcap", tmp_path / "other.mcap"
    narrow = StepLayout(n_joints=2, n_layers=0)
    data = rows(60)
    for path, layout in ((one, LAYOUT), (other, narrow)):
        with recorder(path, layout) as log:
            columns = LAYOUT.columns(data)
            if layout is narrow:
                columns = {
                    n: c[:, :w] if (w := narrow.widths[n]) == 0 else c for n, c in columns.items()
                }
            log.append(layout.rows(columns))
            log.finish(OK)
    found = difference(one, other)
    assert found.widths["weight_norm"] == (4, 0)
    assert not found.columns


def test_snapshots_of_the_same_time_are_compared_whatever_the_steps(tmp_path):
    logs = tmp_path / "one.mcap", tmp_path / "other.mcap"
    for log, dt in zip(logs, (0.001, 0.002), strict=True):
        run_logged(load_scenario("paper", ["controller={kind: pd}", "duration=1", f"dt={dt}"]), log)
    told = [text.split(":")[0] for text in difference(*logs).snapshots]
    assert told == ["world at 1 s"]  # the laws have no memory


def test_the_command_says_it_and_so_does_its_exit_status(tmp_path):
    one, other = changed(tmp_path), changed(tmp_path, ("q", 40, 1, 0.25))
    same = diff(one, one)
    assert (same.returncode, same.stdout) == (0, "all 230 ticks are the same, bit for bit\n")
    told = diff(one, other)
    assert told.returncode == 1
    assert "first difference: tick 40, t = 0.04 s: q[1] = " in told.stdout
    said = json.loads(diff(one, other, "--json").stdout)
    assert said["equal"] is False
    assert said["columns"][0]["first"]["tick"] == 40
    assert said["columns"][0]["largest"]["difference"] == pytest.approx(0.25)
    bad = diff(one, tmp_path / "none.mcap")
    assert (bad.returncode, bad.stdout) == (2, "")
    assert "none.mcap: no such log" in bad.stderr


def test_what_is_no_log_is_refused(tmp_path):
    (tmp_path / "no.mcap").write_text("no log")
    with pytest.raises(LogError, match="expected an MCAP file"):
        difference(changed(tmp_path), tmp_path / "no.mcap")
