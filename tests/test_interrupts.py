"""Ctrl-C, as a person presses it: once, several times, in a table and in JSON."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest
from listening import started

from dnnmso_mj.cli.shared import progress_bar, working
from dnnmso_mj.cli.watching import terminated_like_ctrl_c
from dnnmso_mj.errors import RunInterrupted
from dnnmso_mj.interrupts import heard, held_back, interrupted_once, raise_lost, remember_presses
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.log.background import Background
from dnnmso_mj.reading import log_info, read_trace
from dnnmso_mj.run import run_logged

LONG = ("run", "paper_no_network", "--set", "duration=3000", "--out", "long.mcap")


def running(*args: str, cwd: Path) -> subprocess.Popen[str]:
    """A command that has written a part of its log."""
    process = started(*args, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    end, log = time.monotonic() + 120.0, cwd / "long.mcap"
    while not (log.exists() and log.stat().st_size > 500_000):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end, "it does not run"
        time.sleep(0.01)
    return process


def ended(process: subprocess.Popen[str]) -> tuple[str, str]:
    try:
        return process.communicate(timeout=60)
    finally:
        process.kill()


def test_one_ctrl_c_ends_with_the_summary_of_what_was_run(tmp_path):
    process = running(*LONG, cwd=tmp_path)
    process.send_signal(signal.SIGINT)
    stdout, stderr = ended(process)
    assert process.returncode == 130
    trace = read_trace(tmp_path / "long.mcap")
    assert trace.info.status == "interrupted"
    assert stdout.startswith("paper_no_network, seed 0: interrupted")
    assert all(name in stdout for name in trace.info.metrics)
    ran = f"{len(trace) * 0.001:g} s"
    assert f"\n{ran} of 3000 s simulated in " in stdout
    assert "dnnmso replay long.mcap" in stdout
    assert stderr == f"interrupted; log: long.mcap ({ran} of 3000 s)\n"


def test_pressed_again_and_again_it_still_leaves_a_whole_log_and_whole_json(tmp_path):
    process = running(*LONG, "--json", cwd=tmp_path)
    while process.poll() is None:
        process.send_signal(signal.SIGINT)
        time.sleep(0.002)
    stdout, stderr = ended(process)
    assert process.returncode == 130
    assert "Traceback" not in stderr
    info = log_info(tmp_path / "long.mcap")
    assert (info.complete, info.status) == (True, "interrupted")
    assert info.ticks > 1000
    assert info.metrics["rmse"] is not None
    document = json.loads(stdout)
    assert document["status"] == "interrupted"
    assert document["figures"] == []
    assert document["metrics"] == info.metrics
    assert document["log"] == "long.mcap"


def test_a_ctrl_c_while_a_whole_run_ends_changes_nothing(tmp_path, monkeypatch):
    """Pressed for real, at the moment when the log of a run that is done is being finished."""
    from dnnmso_mj import run

    judge = run.judge

    def press(*arguments):
        os.kill(os.getpid(), signal.SIGINT)
        return judge(*arguments)

    monkeypatch.setattr(run, "judge", press)
    scenario = load_scenario("paper_no_network", ["duration=0.1"])
    done = run_logged(scenario, tmp_path / "run.mcap")
    assert done.trace.info.status == "ok"
    assert log_info(tmp_path / "run.mcap").complete
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler

    def stop(ticks):
        raise KeyboardInterrupt

    with pytest.raises(RunInterrupted) as interrupted:
        run_logged(scenario, tmp_path / "stopped.mcap", progress=stop)
    assert interrupted.value.ticks == len(interrupted.value.run.trace) > 0
    assert log_info(tmp_path / "stopped.mcap").complete


@pytest.mark.parametrize("taken", [False, True], ids=["before it is taken", "after"])
def test_a_ctrl_c_while_a_block_is_handed_over_leaves_a_whole_log(tmp_path, monkeypatch, taken):
    """Wherever in the recorder it comes: the last block is in the log, or it is not."""
    put, blocks = Background.put, 0

    def press(background, job, size=0):
        nonlocal blocks
        blocks += size > 0
        if not size or blocks != 3 or taken:
            put(background, job, size)
        if size and blocks == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(Background, "put", press)
    with pytest.raises(RunInterrupted) as stop:
        run_logged(load_scenario("paper_no_network", ["duration=0.5"]), tmp_path / "run.mcap")
    trace = read_trace(tmp_path / "run.mcap")
    assert log_info(tmp_path / "run.mcap").complete
    assert (trace.info.status, len(trace)) == ("interrupted", stop.value.ticks)
    assert trace["t"].tolist() == [k * 0.001 for k in range(len(trace))]


def test_the_first_raises_and_the_others_do_not():
    with interrupted_once():
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)


def test_what_must_not_be_broken_off_comes_to_its_end():
    done = []

    def work(number):
        with held_back():
            with held_back():
                os.kill(os.getpid(), number)
                os.kill(os.getpid(), number)
            done.append(number)

    with pytest.raises(KeyboardInterrupt):
        work(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    with terminated_like_ctrl_c():
        with pytest.raises(KeyboardInterrupt):
            work(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
    work(0)
    assert done == [signal.SIGINT, signal.SIGTERM, 0]


def press_in_vain(*_):
    """As where a library is imported that has a bare except, or in a callback from C."""
    with suppress(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)


def test_one_that_a_library_swallows_is_raised_again():
    with interrupted_once() as end:
        press_in_vain()
        with pytest.raises(KeyboardInterrupt):
            raise_lost()
        end()
        raise_lost()
    before, told = signal.getsignal(signal.SIGINT), sys.unraisablehook
    remember_presses()
    try:
        raise_lost()
        press_in_vain()
        with pytest.raises(KeyboardInterrupt), working("checking"):
            pass
        with pytest.raises(KeyboardInterrupt), progress_bar("run", 1):
            pass
    finally:
        heard()
        signal.signal(signal.SIGINT, before)
        sys.unraisablehook = told


def test_a_run_ends_by_one_that_a_library_swallows(tmp_path):
    scenario = load_scenario("paper_no_network", ["duration=0.3"])
    with pytest.raises(RunInterrupted) as interrupted:
        run_logged(scenario, tmp_path / "run.mcap", progress=press_in_vain)
    assert 0 < interrupted.value.ticks < scenario.n_ticks
    assert log_info(tmp_path / "run.mcap").status == "interrupted"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_whoever_handles_signals_otherwise_is_left_alone():
    calls = []
    before = signal.signal(signal.SIGINT, lambda *_: calls.append(1))
    try:
        with interrupted_once():
            os.kill(os.getpid(), signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)
    assert calls == [1]
    failures = []

    def elsewhere():
        try:
            with interrupted_once() as end:
                end()
        except ValueError as error:  # signals can be set in the first thread alone
            failures.append(error)

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert not failures
