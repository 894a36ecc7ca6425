"""One tick of the closed loop, against one step of the same arm with nothing around it."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from dnnmso_mj.bench.environments import Arm, arms
from dnnmso_mj.bench.timing import Check, Contender, Probe, Table, race
from dnnmso_mj.bench.torch_loop import TorchLoop
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.run import run_logged
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.simulation import simulate

Array = np.ndarray

US_PER_S = 1e6
CHECKED_TICKS = 200


def bench_tick(quick: bool) -> list[Table]:
    """The paper's loop tick by tick, and the control step inside it."""
    ticks, rounds = (200, 3) if quick else (2000, 10)
    return [_control_table(ticks, rounds), _tick_table(paper(ticks), rounds)]


def paper(ticks: int, precision: str | None = None, controller: str | None = None) -> Scenario:
    """The paper's scenario, cut to so many ticks; in another precision, by another controller."""
    sets = [] if precision is None else [f"controller.network.precision={precision}"]
    return load_scenario("paper", [f"duration={ticks * 1e-3}", *sets], controller=controller)


def loop_probe(scenario: Scenario, mjcf: Mjcf | None = None) -> Probe:
    """Times whole runs in memory: one sample a run, µs a tick."""

    def probe() -> Array:
        info = simulate(scenario, mjcf).info
        return np.array([info.wall_s / scenario.n_ticks * US_PER_S])

    return probe


def _control_table(ticks: int, rounds: int) -> Table:
    single, double = (paper(ticks, precision=name) for name in ("float32", "float64"))
    memory = paper(ticks, controller="dnn_mso_replay")
    interpreter = "the interpreter: many small calls"
    contenders = [
        Contender("dnnmso_mj, float32", "vector arithmetic", partial(_compute, single)),
        Contender("dnnmso_mj, float64", "vector arithmetic", partial(_compute, double)),
        Contender("dnn_mso_replay, float32", "the same, for each sample replayed too",
                  partial(_compute, memory)),
        Contender("plain PyTorch, float32", interpreter, partial(_torch_compute, single)),
    ]  # fmt: skip
    return Table(
        name="control",
        title="Whole control step, as it runs inside the loop",
        work=(
            "observer, network, inversion with M(q) from MuJoCo, learning; timed inside the loop; "
            "dnn_mso_replay: the controller with memory, which learns from remembered states too"
        ),
        unit="µs",
        rows=race(contenders, rounds),
        checks=_check_torch_loop(),
    )


def _compute(scenario: Scenario) -> Probe:
    return lambda: simulate(scenario)["compute_us"]


def _torch_compute(scenario: Scenario) -> Probe:
    TorchLoop(scenario)  # now, so that a missing torch is told of

    def probe() -> Array:
        loop = TorchLoop(scenario)
        loop.run()
        return loop.compute_us

    return probe


def _check_torch_loop() -> tuple[Check, ...]:
    scenario = paper(CHECKED_TICKS, precision="float64")
    try:
        loop = TorchLoop(scenario)
    except ImportError:
        return ()
    loop.run()
    error = float(np.abs(loop.q - simulate(scenario)["q"]).max())
    return (Check(f"plain PyTorch loop, float64: q over {CHECKED_TICKS} ticks (rad)", error, 1e-9),)


def _tick_table(scenario: Scenario, rounds: int) -> Table:
    off = load_scenario("paper_no_network", [f"duration={scenario.duration}"])
    mjcf = Mjcf.read(find_model(scenario.plant.model))
    torques = simulate(scenario, mjcf)["tau"]
    contenders = [
        Contender("closed loop, learning", "the network's step", lambda: loop_probe(scenario)),
        Contender("closed loop, learning, full log", "the network's step",
                  lambda: _logged(scenario)),
        Contender("closed loop, network off", "MuJoCo: Runge-Kutta 4 and M(q)",
                  lambda: loop_probe(off)),
    ]  # fmt: skip
    bounds = ("MuJoCo: Runge-Kutta 4", "the interpreter around it", "the interpreter around it")
    for (name, make), bound in zip(arms(scenario, mjcf).items(), bounds, strict=True):
        contenders.append(Contender(name, bound, partial(stepping, make, torques)))
    rows = race(contenders, rounds)
    dt_us = scenario.dt * US_PER_S
    return Table(
        name="tick",
        title="One tick of the paper's loop, and one step of its arm alone",
        work="RK4 at 1 ms, one step a tick; all but the first three only hold a given torque",
        unit="µs",
        rows=rows,
        checks=_check_arms(mjcf),
        details={f"× real time: {row.name}": dt_us / row.median for row in rows if row.median},
    )


def _logged(scenario: Scenario) -> Probe:
    def probe() -> Array:
        with tempfile.TemporaryDirectory() as folder:
            run = run_logged(scenario, Path(folder) / "bench.mcap")
        return np.array([run.info.wall_s / scenario.n_ticks * US_PER_S])

    return probe


def stepping(make: Callable[[], Arm], torques: Array) -> Probe:
    """Times an arm that is made anew and driven through torques (N, n): one sample, µs a tick."""
    make()  # now, so that a missing package is told of

    def probe() -> Array:
        arm = make()
        began = time.perf_counter()
        for tau in torques:
            arm.step(tau)
        return np.array([(time.perf_counter() - began) / len(torques) * US_PER_S])

    return probe


def _check_arms(mjcf: Mjcf) -> tuple[Check, ...]:
    """Every arm, given the torques of our loop, goes where our loop went."""
    scenario, checks = paper(CHECKED_TICKS), []
    trace = simulate(scenario, mjcf)
    states = np.hstack([trace["q"], trace["qd"]])
    for name, make in arms(scenario, mjcf).items():
        try:
            arm = make()
        except ImportError:
            continue
        error = 0.0
        for x, tau in zip(states, trace["tau"], strict=True):
            error = max(error, float(np.abs(arm.state() - x).max()))
            arm.step(tau)
        checks.append(Check(f"{name}: state over {CHECKED_TICKS} ticks", error, 1e-9))
    return tuple(checks)
