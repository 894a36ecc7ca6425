"""Real time: absolute deadlines, misses told by their cause, and the watchdog."""

from __future__ import annotations

import gc
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from dnnmso_mj.dynamics import TwoLink
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.realtime import left_in_peace, real_time_pace
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.simulation import Simulation, simulate
from dnnmso_mj.timing import timing
from dnnmso_mj.trace import Trace

pytestmark = pytest.mark.alone

CLOCKED = {"compute_us", "wake_late_us", "deadline_missed"}


def run_paced(scenario: Scenario, mjcf: Mjcf, controller=None) -> Trace:
    simulation = Simulation(scenario, mjcf, pace=real_time_pace(scenario), controller=controller)
    recorder = MemoryRecorder(simulation.layout, scenario.n_ticks)
    with left_in_peace():
        info = simulation.run(recorder)
    return recorder.trace(scenario, info)


def test_a_paced_run_takes_its_time_and_is_the_run_it_would_be_unpaced(make_scenario, two_link):
    """Ticks of 20 ms, which even a busy machine does not miss."""
    scenario = make_scenario(duration=1.0, dt=0.02)
    began = time.monotonic()
    paced = run_paced(scenario, two_link)
    assert time.monotonic() - began >= 1.0 - 0.02
    assert not paced["deadline_missed"].any()
    free = simulate(scenario, two_link)
    for name in set(free) - CLOCKED:
        assert np.array_equal(paced[name], free[name]), name
    assert np.all(free["wake_late_us"] == 0)
    assert np.all(paced["wake_late_us"] >= 0)


def test_deadlines_are_absolute_so_that_nothing_drifts(make_scenario, two_link):
    """Half a second of hanging is caught up with, not added."""
    stalls = {"stalls": [{"at": 0.5, "duration": 0.3}, {"at": 0.6, "duration": 0.2}]}
    scenario = make_scenario({"kind": "no_network"}, duration=2.0, real_time=stalls)
    trace = run_paced(scenario, two_link)
    assert trace.info.wall_s < 2.25
    assert np.count_nonzero(trace["deadline_missed"]) >= 500  # the second waits for the first


def test_what_is_true_stays_true_while_no_command_comes(make_scenario, two_link):
    """f_true = −M⁻¹(V + G) at the arm's own state, and the bound holds, in missed ticks too."""
    inversion = {"K": [40.0], "lam": 40.0}
    stalls = {"watchdog": "hold", "stalls": [{"at": 0.6, "duration": 0.4}]}
    scenario = make_scenario(
        {"kind": "no_network", "inversion": inversion},
        duration=1.4,
        real_time=stalls,
        plant={"gravity": 0.0},
        initial={"q": [0.0, 1.0], "qd": [0.5, 0.0]},
    )
    trace = run_paced(scenario, two_link)
    assert np.count_nonzero(trace["deadline_missed"]) >= 400
    free = TwoLink((1.0, 2.3), (1.0, 1.0), gravity=0.0).acceleration(
        trace["q"], trace["qd"], np.zeros((len(trace), 2))
    )
    assert np.allclose(trace["f_true"][:, 2:], free, rtol=1e-9, atol=1e-8)
    assert compute_metrics(trace)["bound_violations"] == 0


def test_a_stall_after_the_end_is_refused(make_scenario):
    with pytest.raises(ValueError, match=r"at the end or after it; allowed: below 1 s"):
        make_scenario(duration=1.0, real_time={"stalls": [{"at": 1.0, "duration": 0.1}]})


def test_a_watchdog_that_bursts_is_named(make_scenario, two_link):
    real_time = {"watchdog": "damped", "damping": 1e30, "stalls": STALLS[:1]}
    simulation_info = run_paced(make_scenario(duration=0.5, real_time=real_time), two_link).info
    assert simulation_info.status == "diverged"
    assert simulation_info.reason.startswith("the watchdog's tau = ")


STALLS = [{"at": 0.3, "duration": 0.05}, {"at": 0.6, "duration": 0.05}]


@pytest.mark.parametrize("watchdog", ["hold", "zero", "damped"])
def test_every_stall_is_reported_and_the_watchdog_acts_throughout(
    make_scenario, two_link, watchdog
):
    real_time = {"watchdog": watchdog, "damping": 3.0, "stalls": STALLS}
    trace = run_paced(make_scenario(duration=0.9, real_time=real_time), two_link)
    assert len(trace) == 900
    long = [miss for miss in timing(trace).misses if miss.cause == "computing"]
    assert [miss.t for miss in long] == pytest.approx([0.3, 0.6])
    assert all(miss.ticks >= 50 for miss in long)
    missed = np.flatnonzero(trace["deadline_missed"])
    tau = trace["tau"]
    expected = {
        "hold": tau[missed - 1],
        "zero": np.zeros_like(tau[missed]),
        "damped": -3.0 * trace["qd"][missed],
    }
    assert np.array_equal(tau[missed], expected[watchdog])
    assert np.array_equal(
        tau[~trace["deadline_missed"]], trace["tau_cmd"][~trace["deadline_missed"]]
    )
    messages = [(event.t, event.message) for event in trace.events]
    assert (0.3, "deadline missed: the watchdog acts") in messages
    assert sum("in time again" in message for _, message in messages) >= 2


def test_the_watchdogs_torque_keeps_to_the_torque_limit(make_scenario, two_link):
    parts = {"imperfections": {"torque_limit": [0.5]}, "initial": {"q": [0.5, 0.5], "qd": [5.0]}}
    real_time = {"watchdog": "damped", "damping": 50.0, "stalls": STALLS[:1]}
    trace = run_paced(make_scenario(duration=0.5, real_time=real_time, **parts), two_link)
    assert trace["deadline_missed"].any()
    assert np.abs(trace["tau"]).max() <= 0.5


class Dozing:
    """A controller in Python that sleeps through 50 ms at some of its updates."""

    def __init__(self, controller, updates: set[int]) -> None:
        self._controller, self._updates, self._k = controller, updates, -1
        self.n_layers = controller.n_layers

    def __getattr__(self, name):
        return getattr(self._controller, name)

    def update(self, inputs):
        self._k += 1
        if self._k in self._updates:
            time.sleep(0.05)
        return self._controller.update(inputs)


def test_a_controller_that_overruns_is_found_out_in_an_interpreted_loop_too(
    make_scenario, two_link
):
    scenario = make_scenario({"kind": "no_network"}, duration=0.6, dt=0.005)
    controller = Dozing(Simulation(scenario, two_link).controller, {30, 60})
    long = timing(run_paced(scenario, two_link, controller)).misses
    assert sum(miss.cause == "computing" and miss.ticks >= 10 for miss in long) == 2


class SlowAtFirst(MemoryRecorder):
    """A recorder that takes 50 ms for the state before the first tick."""

    keeps_snapshots = True

    def snapshot(self, name, t, arrays):
        time.sleep(0.05 if t == 0.0 else 0.0)
        super().snapshot(name, t, arrays)


@pytest.mark.parametrize("interpreted", [False, True])
def test_a_first_tick_that_is_begun_too_late_is_the_watchdogs(make_scenario, two_link, interpreted):
    spec = make_scenario({"kind": "no_network"}, duration=0.3, dt=0.005)
    controller = Dozing(Simulation(spec, two_link).controller, set()) if interpreted else None
    simulation = Simulation(spec, two_link, pace=real_time_pace(spec), controller=controller)
    recorder = SlowAtFirst(simulation.layout, spec.n_ticks)
    info = simulation.run(recorder)
    trace = recorder.trace(spec, info)
    assert len(trace) == spec.n_ticks
    assert trace["deadline_missed"][0]
    assert trace["compute_us"][0] == 0
    assert not trace["tau_cmd"][0].any()
    assert not trace["tau"][0].any()


def test_a_process_that_is_not_run_misses_by_waking(tmp_path):
    """Four SIGSTOPs of 50 ms each: as many rows of misses, none blamed on computing."""
    log = tmp_path / "stopped.mcap"
    command = [sys.executable, "-m", "dnnmso_mj", "run", "paper", "--real-time", "--json"]
    command += ["--no-plot", "--out", str(log), "--set", "duration=4"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        try:
            wait_until_it_grows(log)
            for _ in range(4):
                time.sleep(0.3)
                os.kill(process.pid, signal.SIGSTOP)
                time.sleep(0.05)
                os.kill(process.pid, signal.SIGCONT)
            out, _ = process.communicate(timeout=60)
        finally:
            process.kill()
    report = json.loads(out)["real_time"]
    long = [miss for miss in report["misses"] if miss["ticks"] >= 45]
    assert len(long) >= 4
    stopped_while_computing = sum(miss["cause"] == "computing" for miss in long)
    assert stopped_while_computing <= 1  # 10 µs in a thousand: hardly ever


def wait_until_it_grows(log):
    deadline, size = time.monotonic() + 60, None
    while time.monotonic() < deadline:
        now = log.stat().st_size if log.exists() else 0
        if size and now > size:
            return
        size = now
        time.sleep(0.02)
    raise AssertionError(f"{log} does not grow")


def test_peace_is_undone_at_its_end():
    before = sys.getswitchinterval(), gc.isenabled(), os.sched_getscheduler(0), os.nice(0)
    with left_in_peace() as priority:
        assert not gc.isenabled()
        assert sys.getswitchinterval() < before[0]
        assert priority.startswith(("SCHED_FIFO", "nice"))
    assert before == (sys.getswitchinterval(), gc.isenabled(), os.sched_getscheduler(0), os.nice(0))


def test_the_summary_tells_computing_from_waking(tmp_path):
    command = [sys.executable, "-m", "dnnmso_mj", "run", "paper", "--real-time", "--no-plot"]
    command += ["--set", "duration=0.5", "--set", "real_time.stalls=[{at: 0.2, duration: 0.05}]"]
    done = subprocess.run(
        [*command, "--out", str(tmp_path / "a.mcap")], capture_output=True, text=True, check=True
    )
    assert "computing" in done.stdout
    assert "woken late" in done.stdout
    assert "t = 0.200 s" in done.stdout


def test_a_run_without_a_clock_has_no_deadlines():
    trace = simulate(load_scenario("paper", ["duration=0.2"]))
    assert not trace["deadline_missed"].any()
    assert timing(trace).misses == ()
