"""Row 3: no command, however mad, passes a limit of the drives; a limit of a joint stops the arm.

Commands go straight through the compiled path of the drives, with limits, rates, delays and lags at
random, and are what a broken controller may give: enormous, tiny, no numbers, of changing sign. The
torque limit holds exactly. Of the rate, τ_k = τ_{k−1} ± rate·dt is rounded to the nearest torque,
which is off by half a unit in the last place of τ at most, once without and a few times with delay
and lag, whose mean of several such torques is rounded too.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np

from dnnmso_mj.controllers import Command
from dnnmso_mj.environments.episode import Episode
from dnnmso_mj.imperfections.actuators import actuate, build_actuators, start_actuators
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.reading import read_trace
from dnnmso_mj.realtime import real_time_pace
from dnnmso_mj.resume import resume
from dnnmso_mj.run import run_logged
from dnnmso_mj.scenario import Imperfections, Scenario, expand
from dnnmso_mj.simulation import Simulation, simulate
from dnnmso_mj.sweep.task import Task
from dnnmso_mj.trace import Trace
from soak.ended import dnnmso
from soak.tally import Form, Tally

Array = np.ndarray
Rng = np.random.Generator
Drive = Callable[[Any, Array, Array, int], None]

DT = 1e-3
TICKS = 2000  # of one draw of limits
ROUNDING = {True: 1, False: 16}  # units in the last place, without and with delay or lag


def run(form: Form, tally: Tally, folder: Path) -> None:
    """Drives alone, then whole runs, then the safe stop."""
    rng = np.random.default_rng(form.seed)
    fuzz(tally, rng, form.pick(200_000, 10_000_000), through)
    _whole_runs(tally, rng, form.pick(6, 60))
    _stops(tally, rng, form.pick(12, 150))
    _other_ways(tally, folder, rng)


def fuzz(tally: Tally, rng: Rng, total: int, drive: Drive) -> None:
    """Commands to drives of random limits, and what comes out held against these."""
    done, worst = 0, 0.0
    while done < total:
        spec, n = drives(rng), int(rng.integers(1, 8))
        actuators = build_actuators(spec, n, DT)
        start_actuators(actuators)
        asked = commands(rng, TICKS, n)
        given = np.empty_like(asked)
        drive(actuators, asked, given, int(rng.integers(2)) * int(rng.integers(10**9)))
        count = asked.size
        try:
            worst = max(worst, check_limits(spec, asked, given, prompt=actuators.prompt))
        except AssertionError as error:
            tally.lose(f"{spec.model_dump(exclude_defaults=True)}, {n} joints: {error}")
        else:
            tally.survive(count)
        done += count
    tally.figure("fuzzed commands", done)
    tally.figure("change of torque above the rate, units in the last place, worst", worst)


@numba.njit
def through(actuators: Any, asked: Array, given: Array, first: int) -> None:
    """Every command (N, n) in its tick; one that is no number is followed by drives at rest."""
    for k in range(len(asked)):
        actuate(actuators, asked[k], first + k)
        for j in range(asked.shape[1]):
            given[k, j] = actuators.tau[j]
        if not np.isfinite(given[k]).all():
            actuators.tau[:] = 0.0
            actuators.held[:] = 0.0
            actuators.past[:] = 0.0


def drives(rng: Rng) -> Imperfections:
    """Limits over twenty decades; delay and lag in half of the draws."""
    rate, late = rng.random() < 0.7, rng.random() < 0.5
    return Imperfections(
        torque_limit=float(10.0 ** rng.uniform(-10, 8)),
        torque_rate=float(10.0 ** rng.uniform(-8, 12)) if rate else None,
        actuator_delay=float(rng.choice([0.0, rng.uniform(0, 0.02), 0.003])) if late else 0.0,
        actuator_lag=float(rng.choice([0.0, 10.0 ** rng.uniform(-9, 0)])) if late else 0.0,
    )


def commands(rng: Rng, ticks: int, n: int) -> Array:
    """(ticks, n) N·m: each stretch of another kind."""
    sign = np.where(np.arange(ticks) % 2, 1.0, -1.0)[:, None]
    kinds = [
        rng.normal(0.0, 10.0 ** rng.uniform(-12, 12), (ticks, n)),
        sign * 10.0 ** rng.uniform(-320, 308, (ticks, n)),
        sign * rng.choice([1e308, 1.7976931348623157e308, 5e-324, 0.0], (ticks, n)),
        rng.integers(0, 2**64, (ticks, n), dtype=np.uint64).view(np.float64),
        np.cumsum(rng.normal(0.0, 10.0 ** rng.uniform(-6, 6), (ticks, n)), axis=0),
        rng.choice([np.inf, -np.inf, 0.0, -0.0, 1.0], (ticks, n)),
        np.zeros((ticks, n)),
    ]
    which = np.repeat(rng.integers(len(kinds), size=ticks // 50 + 1), 50)[:ticks]
    asked = np.choose(which[:, None], kinds)
    few = rng.random((ticks, n)) < 2e-4
    asked[few] = rng.choice([np.nan, np.inf, -np.inf], int(few.sum()))
    return asked


def check_limits(spec: Imperfections, asked: Array, given: Array, *, prompt: bool) -> float:
    """Assert both limits of torques (N, n) that acted; how far a change was above the rate.

    What is no number may come out as none, and only then: it ends a run before it acts.

    Returns:
        In units in the last place of the larger torque of both.
    """
    n = asked.shape[1]
    assert spec.torque_limit is not None
    most = expand(spec.torque_limit, n)
    bad = ~np.isfinite(given).all(axis=1)
    assert not (np.isnan(asked).any(axis=1) & ~bad).any() or not prompt, "a NaN became a torque"
    reasons = np.isnan(asked).any(axis=1)
    assert not (bad & ~np.maximum.accumulate(reasons)).any(), "a torque became no number"
    given = np.where(bad[:, None], 0.0, given)
    over = np.abs(given) > most
    assert not over.any(), f"tau = {given[over][0]!r}, limit {most[np.argwhere(over)[0][1]]!r}"
    if spec.torque_rate is None:
        return 0.0
    change = expand(spec.torque_rate, n) * DT
    before = np.vstack([np.zeros(n), given[:-1]])
    step = np.where(bad[:, None], 0.0, np.abs(given - before))
    unit = np.spacing(np.maximum(np.maximum(np.abs(given), np.abs(before)), change))
    above = float(((step - change) / unit).max())
    assert above <= ROUNDING[prompt], f"a change {above:g} units above the rate"
    return max(above, 0.0)


def _whole_runs(tally: Tally, rng: Rng, count: int) -> None:
    """Logged columns of closed loops with weak drives."""
    kinds = ("pd", "no_network", "dnn_mso")
    for k in range(count):
        spec = {
            "torque_limit": float(rng.uniform(5, 200)),
            "torque_rate": float(10.0 ** rng.uniform(2, 5)),
            "actuator_delay": float(rng.choice([0.0, 0.0023])),
            "actuator_lag": float(rng.choice([0.0, 0.004])),
        }
        scenario = _scenario(kinds[k % 3], imperfections=spec, duration=0.5, seed=k)
        with tally.case(f"a run of {kinds[k % 3]} with {spec}"):
            check_trace(simulate(scenario))


def check_trace(trace: Trace) -> None:
    """The same limits, of what a run says that acted."""
    spec = trace.scenario.imperfections
    prompt = spec.actuator_delay == spec.actuator_lag == 0.0
    check_limits(spec, trace["tau_cmd"], trace["tau"], prompt=prompt)


def _scenario(kind: str, **parts: Any) -> Scenario:
    reference = {"kind": "sinusoid", "phase": [0.0, 1.5707963267948966]}
    return Scenario(name=kind, controller={"kind": kind}, reference=reference, **parts)


def _stops(tally: Tally, rng: Rng, count: int) -> None:
    """Limits of the joints at random, in runs that pass them."""
    for k in range(count):
        limits = _limits(rng)
        parts: dict[str, Any] = {"safety": limits, "duration": 2.0, "seed": k}
        if k % 3 == 1:
            parts["imperfections"] = {
                "torque_limit": [150.0, 80.0],
                "torque_rate": 2e4,
                "position_bias": 0.3,
                "actuator_lag": 0.002,
            }
        with tally.case(f"a safe stop of {limits}"):
            check_stop(simulate(_scenario(("pd", "no_network", "dnn_mso")[k % 3], **parts)))


def _limits(rng: Rng) -> dict[str, Any]:
    name, sign = (("q_max", 1.0), ("q_min", -1.0), ("qd_max", 1.0))[int(rng.integers(3))]
    value: float | list[float] = float(sign * rng.uniform(0.0, 1.2))
    if name == "qd_max":
        value = float(rng.uniform(0.05, 1.0))
    if rng.random() < 0.4:
        value = [float(value), 50.0 * sign]
    return {
        name: value,
        "response": str(rng.choice(["brake", "brake", "zero"])),
        "stop_time": float(rng.choice([0.05, 0.5, 3.0])),
    }


def beyond(trace: Trace) -> Array:
    """Which ticks (N,) have a joint past a limit of the scenario, by its rows alone."""
    spec, n = trace.scenario.safety, trace.n_joints
    past = np.zeros(len(trace), bool)
    if spec.q_min is not None:
        past |= (trace["q"] < expand(spec.q_min, n)).any(axis=1)
    if spec.q_max is not None:
        past |= (trace["q"] > expand(spec.q_max, n)).any(axis=1)
    if spec.qd_max is not None:
        past |= (np.abs(trace["qd"]) > expand(spec.qd_max, n)).any(axis=1)
    return past


def check_stop(trace: Trace) -> None:
    """The controller has no say from the first tick past a limit on, and the run is not ok."""
    spec, dt, n = trace.scenario.safety, trace.scenario.dt, trace.n_joints
    past, told = beyond(trace), [e for e in trace.events if e.message.startswith("safe stop: ")]
    if not past.any():
        assert (trace.info.status, len(told)) == ("ok", 0), "a stop without a cause"
        assert len(trace) == trace.scenario.n_ticks
        return
    first = int(past.argmax())
    assert trace.info.status == "diverged", f"status {trace.info.status}"
    assert trace.info.reason.startswith("safe stop: "), trace.info.reason
    assert f"at t = {first * dt:.6g} s" in trace.info.reason, trace.info.reason
    assert len(told) == 1, f"{len(told)} events"
    assert (round(told[0].t / dt), told[0].level) == (first, "warning")
    _check_torque(trace, first)
    _check_length(trace, first)
    if trace.scenario.imperfections.torque_limit is not None:
        check_trace(trace)
    joint = int(told[0].message.split("joint ")[1].split(" ")[0])
    assert 1 <= joint <= n
    name = next(word for word in ("q_min", "q_max", "qd_max") if word in told[0].message)
    limit = getattr(spec, name)
    assert f"{name} = {expand(limit, n)[joint - 1]:g} " in told[0].message, told[0].message


def _check_torque(trace: Trace, first: int) -> None:
    """The stop's own law, where the drives let it through as it is."""
    spec, n = trace.scenario.safety, trace.n_joints
    made = trace.scenario.imperfections
    if made.torque_limit or made.torque_rate or made.actuator_lag or made.actuator_delay:
        return
    bend = trace["q"][first:] - trace["q"][first]
    law = -expand(spec.stiffness, n) * bend - expand(spec.damping, n) * trace["qd"][first:]
    law = law if spec.response == "brake" else np.zeros_like(law)
    assert np.allclose(trace["tau"][first:], law, rtol=1e-12, atol=1e-12), "not the stop's torque"
    assert np.array_equal(trace["tau"][:first], trace["tau_cmd"][:first]), "not the controller's"


def _check_length(trace: Trace, first: int) -> None:
    """It ends at rest, or after its time, or with the scenario; not before, and not later."""
    spec, dt = trace.scenario.safety, trace.scenario.dt
    after = np.abs(trace["qd"][first:]).max(axis=1) <= spec.standstill
    rest, longest = round(0.1 / dt), max(1, round(spec.stop_time / dt))
    runs = np.convolve(after, np.ones(rest), "valid") == rest
    at_rest = int(runs.argmax()) + rest if runs.any() else len(trace)
    expected = min(trace.scenario.n_ticks, first + longest, first + at_rest)
    assert len(trace) == expected, f"{len(trace)} ticks, expected {expected}"


def _other_ways(tally: Tally, folder: Path, rng: Rng) -> None:
    """The stop in every way to run: interpreted, paced, resumed, as environment, in a sweep."""
    mjcf = Mjcf.read(find_model("two_link"))
    limits = {"q_max": 0.6, "stop_time": 0.4}
    weak = {"torque_limit": 150.0, "torque_rate": 3e4}
    scenario = _scenario("pd", safety=limits, imperfections=weak, duration=1.0)
    plain = simulate(scenario, mjcf)
    with tally.case("compiled"):
        check_stop(plain)
        assert plain.info.status == "diverged"
    with tally.case("interpreted"):
        _same(_run(Simulation(scenario, mjcf), interpreted=True), plain)
    with tally.case("in real time, with the watchdog"):
        _paced(scenario, mjcf)
    with tally.case("resumed, before the stop and in it"):
        _resumed(scenario, folder, plain)
    with tally.case("as an environment"):
        _environment(scenario)
    with tally.case("in a sweep"):
        rows = list(Task(0, scenario, mjcf, (0, 1))())
        assert [row["diverged"] for row in rows] == [True, True]
        assert all(row["reason"].startswith("safe stop: ") for row in rows)
        assert all(row["rmse"] is row["rmse_steady"] is None for row in rows)
    with tally.case("by the command line"):
        out = folder / "stop.mcap"
        words = ["--set", "safety.q_max=0.6", "--set", "controller.kind=pd", "--json", "--no-plot"]
        ended = dnnmso("run", "paper", *words, "--out", out, cwd=folder)
        assert ended.status == 1, ended.err
        assert json.loads(ended.out)["status"] == "diverged"
        assert "diverged: safe stop: q of joint 2 = " in ended.err, ended.err
        check_stop(read_trace(out))


def _run(simulation: Simulation, *, interpreted: bool = False) -> Trace:
    recorder = MemoryRecorder(simulation.layout, simulation.scenario.n_ticks)
    if interpreted:
        simulation.controller = _Wrapped(simulation.controller)
    return recorder.trace(simulation.scenario, simulation.run(recorder))


class _Wrapped:
    """A controller without its compiled ticks."""

    def __init__(self, controller: Any) -> None:
        self._controller, self.n_layers = controller, controller.n_layers

    def __getattr__(self, name: str) -> Any:
        return getattr(self._controller, name)

    def update(self, inputs: Any) -> Command:
        command: Command = self._controller.update(inputs)
        return command


def _same(one: Trace, other: Trace) -> None:
    assert len(one) == len(other)
    assert one.info.reason == other.info.reason, f"{one.info.reason} / {other.info.reason}"
    # A log's times are whole nanoseconds.
    told = [[(round(e.t, 9), e.level, e.message) for e in each.events] for each in (one, other)]
    assert told[0] == told[1], f"{told[0]} / {told[1]}"
    for name in ("q", "qd", "tau", "tau_cmd"):
        assert np.array_equal(one[name], other[name]), name


def _paced(scenario: Scenario, mjcf: Mjcf) -> None:
    """Hung all through the stop: its brake acts though no command comes."""
    stalls = {"stalls": [{"at": 0.03, "duration": 0.3}], "watchdog": "hold"}
    hung = Scenario.model_validate(scenario.model_dump() | {"real_time": stalls, "duration": 0.8})
    trace = _run(Simulation(hung, mjcf, pace=real_time_pace(hung)))
    assert trace["deadline_missed"].any()
    check_stop(trace)


def _resumed(scenario: Scenario, folder: Path, plain: Trace) -> None:
    log = run_logged(scenario, folder / "whole.mcap").log
    first = int(beyond(plain).argmax())
    for k, tick in enumerate((first - 10, first, first + 1, first + 60)):
        done = resume(log, tick * scenario.dt, out=folder / f"resumed-{k}.mcap")
        _same(done.run.trace, plain)
        _same(read_trace(done.run.log), plain)


def _environment(scenario: Scenario) -> None:
    episode = Episode(scenario)
    episode.restart(episode.scenario)
    while not episode.over:
        episode.hold(np.array([0.0, 60.0]), 1)
    assert episode.error.startswith("safe stop: "), episode.error
    assert episode.reward() == 0.0
    check_stop(episode.trace())
