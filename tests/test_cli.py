"""The command line, by subprocess: what it prints, where, and with which exit status."""

from __future__ import annotations

import json
import os
import pty
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from listening import DNNMSO, started
from trace_samples import METRICS

from dnnmso_mj.loading import list_scenarios
from dnnmso_mj.paths import PACKAGE
from dnnmso_mj.reading import read_trace

ROOT = Path(__file__).parents[1]


def dnnmso(*args: object, cwd: Path, **options) -> subprocess.CompletedProcess[str]:
    command = [str(DNNMSO), *map(str, args)]
    return subprocess.run(
        command, cwd=cwd, capture_output=True, text=True, check=False, timeout=120, **options
    )


@pytest.fixture(scope="module")
def short_log(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("short")
    done = dnnmso("run", "paper", "--set", "duration=0.5", "--no-plot", cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder / "logs" / "paper.mcap"


def test_run_leaves_log_and_figures_and_prints_a_summary(tmp_path):
    done = dnnmso("run", "paper", "--set", "duration=0.3", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    log = tmp_path / "logs" / "paper.mcap"
    assert log.is_file()
    assert "logs/paper.mcap" in done.stdout
    assert "rmse_steady" in done.stdout
    figures = sorted((tmp_path / "logs").glob("*.png"))
    assert len(figures) >= 4
    assert all(f"logs/{figure.name}" in done.stdout for figure in figures)
    assert done.stderr == ""


def test_only_the_first_run_of_all_compiles_and_says_so_and_it_is_the_second_bit_for_bit(tmp_path):
    cache = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    args = ("run", "paper", "--set", "duration=0.3", "--no-plot", "--json")
    first, second = (dnnmso(*args, cwd=tmp_path, env=cache) for _ in range(2))
    assert first.returncode == second.returncode == 0
    assert first.stderr == "compiling the control loop; later runs load it\n"
    assert second.stderr == ""
    assert json.loads(first.stdout)["metrics"]["compute_us_p999"] < 100_000  # not in any tick
    one, two = (read_trace(tmp_path / json.loads(run.stdout)["log"]) for run in (first, second))
    for name in set(one.columns) - {"compute_us", "wake_late_us"}:
        assert one[name].tobytes() == two[name].tobytes(), name


def test_run_json_is_one_object_with_the_promised_keys(tmp_path):
    args = ("--set", "duration=0.3", "--seed", 5, "--out", "a/b.mcap", "--json", "--no-plot")
    done = dnnmso("run", "paper", *args, cwd=tmp_path)
    document = json.loads(done.stdout)
    assert done.returncode == 0
    assert document["status"] == "ok"
    assert document["seed"] == 5
    assert (tmp_path / document["log"]).is_file()
    assert document["wall_s"] > 0
    assert set(document["metrics"]) == METRICS
    assert read_trace(tmp_path / "a" / "b.mcap").info.seed == 5


def test_log_says_the_same_metrics_as_the_run(tmp_path):
    args = ("--set", "duration=0.3", "--out", "a.mcap", "--json", "--no-plot")
    printed = json.loads(dnnmso("run", "paper", *args, cwd=tmp_path).stdout)
    found = json.loads(dnnmso("info", "a.mcap", "--json", cwd=tmp_path).stdout)
    assert found["metrics"] == printed["metrics"]
    assert found["ticks"] == 300
    assert found["status"] == "ok"
    assert found["complete"] is True


def test_two_runs_of_one_seed_write_the_same_steps_but_for_measured_times(tmp_path):
    for name in ("one.mcap", "two.mcap"):
        args = ("--set", "duration=0.5", "--out", name, "--no-plot")
        assert dnnmso("run", "paper", *args, cwd=tmp_path).returncode == 0
    one, two = read_trace(tmp_path / "one.mcap"), read_trace(tmp_path / "two.mcap")
    for name in set(one) - {"compute_us", "deadline_missed"}:
        assert np.array_equal(one[name], two[name]), name


def test_diverged_run_exits_with_1_and_leaves_its_log(tmp_path):
    done = dnnmso("run", "as_printed", "--out", "d.mcap", "--json", cwd=tmp_path)
    assert done.returncode == 1
    assert json.loads(done.stdout)["status"] == "diverged"
    assert done.stderr.startswith("diverged: |x_hat| = ")
    found = json.loads(dnnmso("info", "d.mcap", "--json", cwd=tmp_path).stdout)
    assert found["status"] == "diverged"
    assert found["complete"] is True
    assert found["metrics"]["diverged"] is True
    assert any("diverged" in event["message"] for event in found["events"])


def test_default_log_names_never_overwrite(tmp_path):
    for _ in range(3):
        done = dnnmso("run", "paper", "--set", "duration=0.05", "--no-plot", cwd=tmp_path)
        assert done.returncode == 0
    names = sorted(path.name for path in (tmp_path / "logs").iterdir())
    assert names == ["paper-2.mcap", "paper-3.mcap", "paper.mcap"]


def test_out_is_overwritten_only_by_force(tmp_path):
    args = ("run", "paper", "--set", "duration=0.05", "--out", "x.mcap", "--no-plot")
    assert dnnmso(*args, cwd=tmp_path).returncode == 0
    before = (tmp_path / "x.mcap").read_bytes()
    refused = dnnmso(*args, cwd=tmp_path)
    assert refused.returncode == 2
    assert "x.mcap" in refused.stderr
    assert (tmp_path / "x.mcap").read_bytes() == before
    assert dnnmso(*args, "--force", cwd=tmp_path).returncode == 0


REFUSALS = [
    (("run", "papr"), "did you mean"),
    (("run", "nowhere.yaml"), "no such file"),
    (("run", "paper", "--set", "controller.madam.et=1"), "did you mean"),
    (("run", "paper", "--set", "duration=-1"), "duration"),
    (("run", "paper", "--set", "duration=.nan"), "duration"),
    (("run", "paper", "--set", "initial.q=[1]"), "initial.q"),
    (("run", "paper", "--set", "plant.masses=[1,2,3]"), "plant.lengths"),
    (("run", "paper", "--set", "plant.model=three_link"), "two_link"),
    (("run", "paper", "--set", "nonsense"), "nonsense"),
    (("run", "paper", "--set", "controller=no_network"), "controller.kind=no_network"),
    (("run", "paper", "--seed", "-1"), "seed"),
    (("run", "paper", "--set", "duration=0.01", "--out", "/proc/no/x.mcap"), "/proc/no/x.mcap"),
    (("info", "nothing.mcap"), "nothing.mcap"),
    (("info", "."), "."),
    (("recover", "nothing.mcap"), "nothing.mcap"),
    (("plot", "nothing.mcap"), "nothing.mcap"),
    (("replay", "nothing.mcap", "--save", "x.rrd"), "nothing.mcap"),
    (("replay", "nothing.mcap", "--serve", "--port", "0"), "--port"),
    (("check", "--model", "nowhere.xml"), "nowhere.xml"),
    (("check", "--states", "0"), "--states"),
    (("run",), "SCENARIO"),
    (("fly",), "fly"),
]


@pytest.mark.parametrize(("args", "message"), REFUSALS, ids=lambda value: " ".join(value)[:60])
def test_every_refusal_is_one_message_and_status_2_and_leaves_nothing(tmp_path, args, message):
    done = dnnmso(*args, cwd=tmp_path)
    assert done.returncode == 2
    assert message.lower() in done.stderr.lower()
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_a_typo_in_a_file_is_refused_with_file_line_key_and_hint(tmp_path):
    text = (ROOT / "scenarios" / "paper.yaml").read_text()
    wrong = text.replace("gravity:", "gravty:")
    (tmp_path / "mine.yaml").write_text(wrong)
    line = next(k for k, row in enumerate(wrong.splitlines(), 1) if "gravty:" in row)
    done = dnnmso("run", "mine.yaml", cwd=tmp_path)
    assert done.returncode == 2
    assert f"mine.yaml:{line}: plant.gravty" in done.stderr
    assert "did you mean 'gravity'" in done.stderr
    assert not (tmp_path / "logs").exists()


def test_a_torque_limit_that_cannot_hold_the_arm_warns_and_runs(tmp_path):
    limit = ("--set", "imperfections.torque_limit=30", "--set", "duration=0.05", "--no-plot")
    done = dnnmso("run", "paper", *limit, cwd=tmp_path)
    assert done.returncode == 0
    assert "warning: " in done.stderr
    assert "54.9" in done.stderr


def test_check_passes_on_the_shipped_arm_and_fails_on_a_geared_one(tmp_path):
    good = dnnmso("check", "--states", 500, "--json", cwd=tmp_path)
    document = json.loads(good.stdout)
    assert good.returncode == 0
    assert document["status"] == "ok"
    for errors in document["max_relative_error"].values():
        assert set(errors) == {"M", "V", "G", "qdd"}
        assert max(errors.values()) <= 1e-10
    geared = (
        (ROOT / "models" / "two_link.xml").read_text().replace('armature="0"', 'armature="0.1"')
    )
    (tmp_path / "geared.xml").write_text(geared)
    bad = dnnmso("check", "--states", 500, "--model", "geared.xml", cwd=tmp_path)
    assert bad.returncode == 1
    assert "FAILED" in bad.stdout


def test_plot_draws_figures_and_a_comparison(tmp_path, short_log):
    other = tmp_path / "other.mcap"
    args = ("--set", "duration=0.5", "--out", other, "--no-plot")
    assert dnnmso("run", "paper_no_network", *args, cwd=tmp_path).returncode == 0
    done = dnnmso("plot", short_log, other, "--out", "figures", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    paths = [tmp_path / line for line in done.stdout.split()]
    assert len(paths) > 8
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths)


def test_logs_of_one_name_are_told_apart_in_a_comparison(tmp_path, short_log):
    done = dnnmso("plot", short_log, short_log, "--out", "figures", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    names = {Path(line).name for line in done.stdout.split()}
    assert {"1-paper_error.png", "2-paper_error.png", "comparison_error.png"} <= names


def test_recover_makes_a_whole_log_of_a_torn_one(tmp_path, short_log):
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(short_log.read_bytes()[:-20_000])
    found = json.loads(dnnmso("info", torn, "--json", cwd=tmp_path).stdout)
    assert found["complete"] is False
    done = dnnmso("recover", torn, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    whole = json.loads(dnnmso("info", "torn-recovered.mcap", "--json", cwd=tmp_path).stdout)
    assert whole["complete"] is True
    assert whole["ticks"] == found["ticks"] > 0


def test_replay_saves_a_rerun_recording(tmp_path, short_log):
    done = dnnmso("replay", short_log, "--save", "x.rrd", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "x.rrd").read_bytes().startswith(b"RRF2")


def test_schema_and_scenarios_are_listed(tmp_path):
    schema = json.loads(dnnmso("schema", cwd=tmp_path).stdout)
    assert schema == json.loads((ROOT / "scenarios" / "scenario.schema.json").read_text())
    listed = json.loads(dnnmso("scenarios", "--json", cwd=tmp_path).stdout)
    assert [(e["name"], e["description"]) for e in listed] == list_scenarios()
    table = dnnmso("scenarios", cwd=tmp_path).stdout
    assert all(name in table for name, _ in list_scenarios())


def test_help_and_version_answer(tmp_path):
    for command in ([str(DNNMSO)], [sys.executable, "-m", "dnnmso_mj"]):
        shown = subprocess.check_output([*command, "--help"], cwd=tmp_path, text=True)
        assert "replay" in shown
    assert dnnmso("--version", cwd=tmp_path).stdout.count(".") == 2


def test_ctrl_c_while_the_loop_is_compiled_is_one_line_and_leaves_no_process(tmp_path):
    cold = {"NUMBA_CACHE_DIR": str(tmp_path / "cold")}
    process = started(
        "run", "paper", "--no-plot", cwd=tmp_path, stderr=subprocess.PIPE, env=os.environ | cold
    )
    try:
        assert process.stderr.readline().startswith("compiling")
        assert len(processes_with(f"NUMBA_CACHE_DIR={cold['NUMBA_CACHE_DIR']}")) == 2
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130
    assert stderr == "interrupted; log: logs/paper.mcap (0 s of 10 s)\n"
    assert not processes_with(f"NUMBA_CACHE_DIR={cold['NUMBA_CACHE_DIR']}")


def processes_with(setting: str) -> list[str]:
    found = []
    for environ in Path("/proc").glob("[0-9]*/environ"):
        with suppress(OSError):
            if setting.encode() in environ.read_bytes().split(b"\0"):
                found.append(environ.parent.name)
    return found


def test_ctrl_c_ends_a_run_with_its_log_whole_and_says_where_it_is(tmp_path):
    args = ("run", "paper", "--set", "duration=600", "--out", "long.mcap")
    process = started(*args, cwd=tmp_path, stderr=subprocess.PIPE)
    try:
        log = tmp_path / "long.mcap"
        wait_until(lambda: log.exists() and log.stat().st_size > 1_000_000)
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130
    trace = read_trace(log)
    assert trace.info.status == "interrupted"
    assert len(trace) > 100
    ran = f"{len(trace) * 0.001:g} s of 600 s"
    assert stderr == f"interrupted; log: long.mcap ({ran})\n"


def test_ctrl_c_outside_a_run_is_told_too(tmp_path):
    parent, child = pty.openpty()
    process = started("check", "--states", 100_000_000, cwd=tmp_path, stderr=child)
    os.close(child)
    try:
        read_until(parent, b"comparing")
        process.send_signal(signal.SIGINT)
        read_until(parent, b"interrupted")
        assert process.wait(timeout=60) == 130
    finally:
        process.kill()


def read_until(terminal: int, word: bytes) -> None:
    shown = b""
    while word not in shown:
        shown += os.read(terminal, 65536)  # fails where the process ends without the word


@pytest.mark.parametrize("args", [("schema",), ("scenarios",), ("scenarios", "--json")])
def test_a_full_output_is_one_line_and_status_2(tmp_path, args):
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [str(DNNMSO), *args],
            cwd=tmp_path,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == 2
    assert done.stderr == ("error: standard output cannot be written: No space left on device\n")


def test_an_output_that_knows_only_ascii_gets_what_it_knows(tmp_path):
    ascii_only = {**os.environ, "PYTHONIOENCODING": "ascii"}
    args = ("run", "paper", "--set", "duration=0.05", "--no-plot")
    done = dnnmso(*args, cwd=tmp_path, env=ascii_only)
    assert done.returncode == 0, done.stderr
    assert "N?m" in done.stdout
    assert done.stdout.isascii()


def test_no_place_for_compiled_code_says_what_to_set(tmp_path):
    """Files and /proc, where folders should be, stand for those that cannot be written."""
    package = tmp_path / "dnnmso_mj"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    for folder in [package, *(path for path in package.rglob("*") if path.is_dir())]:
        (folder / "__pycache__").write_text("")
    for name in ("models", "scenarios"):
        (tmp_path / name).symlink_to(ROOT / name)
    kept = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    nowhere = {"HOME": "/proc/none", "XDG_CACHE_HOME": "/proc/none", "PYTHONPATH": str(tmp_path)}
    command = [sys.executable, "-m", "dnnmso_mj", "run", "paper", "--set", "duration=0.05"]
    done = subprocess.run(
        command, cwd=tmp_path, env=kept | nowhere, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr.startswith("error: no folder where numba may keep compiled code")
    assert "NUMBA_CACHE_DIR" in done.stderr
    assert done.stderr.count("\n") == 1


def test_what_mujoco_warns_of_is_told_and_leaves_no_file_behind(tmp_path):
    heavy = ("plant.gravity=1e12", "plant.integrator=euler", "duration=0.05")
    sets = [word for item in heavy for word in ("--set", item)]
    done = dnnmso("run", "paper_no_network", *sets, "--no-plot", cwd=tmp_path)
    assert done.returncode == 1
    assert "diverged: " in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["logs"]


def test_a_model_that_does_not_fit_is_told_with_file_line_and_key(tmp_path):
    model = (ROOT / "models" / "two_link.xml").read_text()
    (tmp_path / "mine.xml").write_text(model.replace('damping="0"', 'damping="1"'))
    text = (ROOT / "scenarios" / "paper.yaml").read_text()
    (tmp_path / "mine.yaml").write_text(text.replace("model: two_link", "model: mine.xml"))
    line = next(k for k, row in enumerate(text.splitlines(), 1) if "model: two_link" in row)
    done = dnnmso("run", "mine.yaml", cwd=tmp_path)
    assert done.returncode == 2
    assert f"error: mine.yaml:{line}: plant.model = " in done.stderr
    assert "joint 'joint1' has damping" in done.stderr
    done = dnnmso("run", "paper", "--set", "plant.model=mine.xml", cwd=tmp_path)
    assert "error: --set plant.model=mine.xml: plant.model = " in done.stderr
    sets = ("initial.q=[0, 0, 0]", "plant.masses=null", "plant.lengths=null")
    sets += ("reference.phase=0",)
    words = [word for item in sets for word in ("--set", item)]
    done = dnnmso("run", "paper", *words, cwd=tmp_path)
    assert "error: --set initial.q=[0, 0, 0]: initial.q has 3 entries" in done.stderr
    assert not (tmp_path / "logs").exists()


def test_check_names_the_model_that_it_was_given(tmp_path):
    model = (ROOT / "models" / "two_link.xml").read_text()
    hand = '<body name="hand"><geom size="0.1"/></body><site name="tip"'
    (tmp_path / "arm3.xml").write_text(model.replace('<site name="tip"', hand))
    done = dnnmso("check", "--model", "arm3.xml", "--states", 1, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("error: --model arm3.xml: 3 bodies and 2 joints; allowed: 2")
    (tmp_path / "torn.xml").write_text(model[:500])
    done = dnnmso("check", "--model", "torn.xml", "--states", 1, cwd=tmp_path)
    assert done.stderr.startswith("error: --model torn.xml: torn.xml:1: not XML")


def test_logs_that_cannot_be_compared_leave_no_figures(tmp_path, short_log):
    one = """<mujoco><worldbody><body name="link1"><joint name="j" axis="0 -1 0"/>
      <geom size="0.1" mass="1" contype="0" pos="1 0 0"/></body></worldbody>
      <actuator><motor joint="j"/></actuator></mujoco>"""
    (tmp_path / "one.xml").write_text(one)
    (tmp_path / "one.yaml").write_text(
        "name: one\nduration: 0.1\nplant: {model: one.xml}\ninitial: {q: [0]}\n"
        "reference: {kind: sinusoid}\ncontroller: {kind: no_network}\n"
    )
    done = dnnmso("run", "one.yaml", "--no-plot", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    done = dnnmso("plot", short_log, "logs/one.mcap", "--out", "figures", cwd=tmp_path)
    assert done.returncode == 2
    assert "runs with [1, 2] joints cannot be compared" in done.stderr
    assert list(tmp_path.rglob("*.png")) == []


def test_progress_bar_shows_on_a_terminal_only(tmp_path):
    """`short_log` and others assert that nothing is on standard error without a terminal."""
    parent, child = pty.openpty()
    command = [str(DNNMSO), "run", "paper", "--set", "duration=3", "--no-plot"]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=child)
    os.close(child)
    shown = b""
    while process.poll() is None or shown == b"":
        try:
            shown += os.read(parent, 65536)
        except OSError:  # the terminal closes when the process ends
            break
    assert process.wait(timeout=60) == 0
    assert b"%" in shown


def wait_until(condition, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing happened in time"
        time.sleep(0.02)
