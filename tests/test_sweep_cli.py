"""`dnnmso sweep` by subprocess: what it prints, what signals do to it, what it leaves behind."""

from __future__ import annotations

import json
import os
import pty
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from sweep_samples import DNNMSO, children, dnnmso, rows_in, untimed, wait_until

from dnnmso_mj.paths import scenarios_dir
from dnnmso_mj.sweep.local import LocalEngine
from dnnmso_mj.sweep.plan import plan_sweep
from dnnmso_mj.sweep.run import run_sweep
from dnnmso_mj.sweep.table import METRIC_TYPES

SETS = ("--set", "duration=0.1")
LONG = ("sweep", "paper", "--seeds", "0:200", "--set", "duration=0.3", "--out", "long.parquet")
JOURNAL = "long.parquet.journal"


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> pa.Table:
    """The table of `LONG`, made without interruption."""
    plan = plan_sweep("paper", range(200), ["duration=0.3"])
    return run_sweep(plan, tmp_path_factory.mktemp("long") / "x.parquet", LocalEngine(2)).table


def start(*more: str, cwd: Path) -> subprocess.Popen[str]:
    command = [str(DNNMSO), *LONG, *more]
    return subprocess.Popen(
        command, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def test_a_sweep_leaves_a_table_and_says_what_it_holds(tmp_path):
    grid = ("--grid", "plant.gravity=9.81,1.62")
    done = dnnmso("sweep", "paper", "--seeds", "0:6", *SETS, *grid, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert pq.read_table(tmp_path / "logs" / "paper.parquet").num_rows == 12
    assert "paper, plant.gravity = 1.62: 6 of 6 runs ok" in done.stdout
    assert all(name in done.stdout for name in set(METRIC_TYPES) - {"diverged"})
    assert "12 runs: 12 ok, 0 diverged, 0 failed" in done.stdout
    assert "logs/paper.parquet" in done.stdout
    assert "ticks/s" in done.stdout
    assert "…" not in done.stdout  # nothing is cut at 80 columns
    assert max(map(len, done.stdout.splitlines())) <= 80
    assert [path.name for path in (tmp_path / "logs").iterdir()] == ["paper.parquet"]


def test_json_is_one_object_with_every_point_and_every_failure(tmp_path):
    grid = ("--grid", "controller.observer.feedback=stable,as_printed")
    fast = ("--set", "controller.observer.K2=300")
    args = ("--seeds", "0:6", *SETS, *fast, *grid, "--json", "--jobs", "2")
    done = dnnmso("sweep", "paper", *args, cwd=tmp_path)
    assert done.returncode == 0
    assert done.stderr == "6 of 12 runs diverged or failed\n"
    document = json.loads(done.stdout)
    assert document["status"] == "completed"
    assert (document["rows"], document["ok"], document["diverged"]) == (12, 6, 6)
    assert (document["jobs"], document["engine"]) == (2, "local")
    assert document["ticks_per_s"] == pytest.approx(document["ticks"] / document["wall_s"])
    stable, printed = document["points"]
    assert set(stable["metrics"]) == set(METRIC_TYPES) - {"diverged"}
    named = {"n", "median", "q25", "q75", "ci_low", "ci_high", "ci_method"}
    assert set(stable["metrics"]["rmse"]) == named
    assert stable["metrics"]["rmse"]["ci_method"] == "bootstrap"
    assert printed["metrics"]["rmse"]["n"] == 0
    assert [failure["seed"] for failure in document["failures"]] == list(range(6))
    assert document["failures"][0]["parameters"] == printed["parameters"]
    assert document["failures_left_out"] == 0


def test_failures_are_listed_and_the_list_is_cut_with_a_count(tmp_path):
    fast = ("--set", "controller.observer.K2=300")
    done = dnnmso("sweep", "as_printed", "--seeds", "0:14", *SETS, *fast, cwd=tmp_path)
    assert "as_printed: 0 of 14 runs ok" in done.stdout
    assert "  seed 9 diverged: |x_hat| = " in done.stdout
    assert "seed 10" not in done.stdout
    assert "… and 4 more; the table has them all" in done.stdout
    assert "14 runs: 0 ok, 14 diverged, 0 failed" in done.stdout
    assert done.stderr == "14 of 14 runs diverged or failed\n"


def test_few_seeds_have_no_interval_and_the_summary_says_so(tmp_path):
    done = dnnmso("sweep", "paper", "--seeds", "0:5", *SETS, cwd=tmp_path)
    assert "too few runs" in done.stdout


REFUSALS = [
    (("--seeds", "4:4"), "4:4 is empty"),
    (("--seeds", "0:2", "--set", "plant.gravty=1"), "did you mean 'gravity'"),
    (("--seeds", "0:2", "--grid", "plant.gravity=1,-1"), "--grid plant.gravity=-1: plant.gravity"),
    (("--seeds", "0:2", "--grid", "plant.model=none_such"), "none_such"),
    (("--seeds", "0:2", "--jobs", "0"), "--jobs"),
    (("--seeds", "0:2", "--engine", "spark"), "allowed: local, ray"),
    (("--seeds", "0:2", "--address", "auto"), "with --engine ray"),
    (("--seeds", "0:2", "--resume", "--force"), "allowed: one of them"),
    (("--seeds", "0:2", "--out", "/proc/no/x.parquet"), "/proc/no/x.parquet"),
    (("--seeds", "0:2", "--out", "."), "a folder"),
    ((), "--seeds"),
]


@pytest.mark.parametrize(("args", "message"), REFUSALS, ids=lambda value: " ".join(value)[:50])
def test_every_refusal_is_one_message_and_status_2_and_leaves_nothing(tmp_path, args, message):
    done = dnnmso("sweep", "paper", *SETS, *args, cwd=tmp_path)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert list(tmp_path.iterdir()) == []


def test_force_does_not_write_over_the_scenario_itself(tmp_path):
    mine = tmp_path / "mine.yaml"
    mine.write_text((scenarios_dir() / "paper.yaml").read_text())
    before = mine.read_bytes()
    args = ("--seeds", "0:2", "--out", "mine.yaml", "--force")
    done = dnnmso("sweep", "mine.yaml", *SETS, *args, cwd=tmp_path)
    assert done.returncode == 2
    assert "mine.yaml: exists and is not a table of `dnnmso sweep`" in done.stderr
    assert mine.read_bytes() == before
    assert list(tmp_path.iterdir()) == [mine]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda n: n.name)
def test_a_signal_keeps_what_is_done_and_says_how_to_go_on(tmp_path, undisturbed, number):
    process = start("--jobs", "2", cwd=tmp_path)
    wait_until(lambda: rows_in(tmp_path / JOURNAL) > 10)
    workers = children(process.pid)
    process.send_signal(number)
    stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == 130
    assert stdout == ""
    assert len(workers) == 2
    assert not any(Path(f"/proc/{pid}").exists() for pid in workers)
    message, command = stderr.splitlines()
    kept = rows_in(tmp_path / JOURNAL)
    assert message == f"interrupted; {kept} of 200 rows are kept beside long.parquet; to go on:"
    assert shlex.split(command) == ["dnnmso", *LONG, "--jobs", "2", "--resume"]
    assert not (tmp_path / "long.parquet").exists()
    done = dnnmso(*shlex.split(command)[1:], "--json", cwd=tmp_path)
    assert json.loads(done.stdout)["rows_kept"] == kept
    assert untimed(pq.read_table(tmp_path / "long.parquet")).equals(untimed(undisturbed))
    assert [path.name for path in tmp_path.iterdir()] == ["long.parquet"]


def test_kill_9_loses_only_the_runs_under_way_and_leaves_no_process(tmp_path, undisturbed):
    process = start(cwd=tmp_path)
    wait_until(lambda: rows_in(tmp_path / JOURNAL) > 10)
    workers = children(process.pid)
    process.kill()
    process.communicate(timeout=60)
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in workers))
    assert 10 < rows_in(tmp_path / JOURNAL) < 200
    done = dnnmso(*LONG, "--resume", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "of them were there before" in done.stdout
    assert untimed(pq.read_table(tmp_path / "long.parquet")).equals(untimed(undisturbed))


def test_a_killed_worker_costs_no_row_and_a_second_sweep_must_wait(tmp_path, undisturbed):
    process = start("--json", cwd=tmp_path)
    wait_until(lambda: rows_in(tmp_path / JOURNAL) > 10)
    os.kill(children(process.pid)[0], signal.SIGKILL)
    second = dnnmso(*LONG, "--resume", cwd=tmp_path)
    stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == 0, stderr
    assert json.loads(stdout)["ok"] == 200
    assert untimed(pq.read_table(tmp_path / "long.parquet")).equals(untimed(undisturbed))
    assert second.returncode in {0, 2}  # 0: where the first had ended before it
    assert second.returncode == 0 or "another sweep is writing it now" in second.stderr


def test_progress_shows_on_a_terminal_only(tmp_path):
    """Other tests assert that nothing is on standard error without one."""
    parent, child = pty.openpty()
    command = [str(DNNMSO), "sweep", "paper", "--seeds", "0:40", "--set", "duration=0.4"]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=child)
    os.close(child)
    shown = b""
    while True:
        try:
            shown += os.read(parent, 65536)
        except OSError:  # the terminal closes when the process ends
            break
    assert process.wait(timeout=60) == 0
    assert b"/40" in shown
    assert b"ticks/s" in shown


def test_heavy_libraries_wait_until_they_are_needed(tmp_path):
    code = (
        "import sys; import dnnmso_mj.cli, dnnmso_mj.sweep.worker, dnnmso_mj.sweep.task;"
        "print({'ray', 'torch', 'pyarrow', 'scipy.stats', 'matplotlib'} & set(sys.modules))"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout == "set()\n"
