"""Row 1: what is not finite ends the run, by name, and is never given to MuJoCo.

Faults go into real logged runs at random ticks: compiled ones, whose arrays are changed between two
ticks, and interpreted ones. Others come by code from outside on the command line, as actions of an
environment, or from a scenario of huge numbers.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from dnnmso_mj.loading import controller_kinds, load_scenario
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.reading import log_info, read_snapshots, read_trace
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.simulation import Simulation, simulate
from soak.ended import dnnmso
from soak.faulted import check
from soak.faults import Fault, places, run_struck, witness
from soak.tally import Form, Tally

VALUES = (np.nan, np.inf, -np.inf, 1e300, -1e300)
SHORT_KINDS = ("dnn_mso", "dnn_mso_replay", "lewis_nn", "no_network", "pd")
DURATION = 0.25  # s
IMPERFECT = {
    "torque_limit": 200.0,
    "torque_rate": 2e4,
    "actuator_lag": 0.004,
    "actuator_delay": 0.0023,
    "sensor_delay": 0.0017,
    "jitter": 0.001,
    "position_noise": 1e-4,
    "velocity_noise": 1e-3,
    "friction": {"viscous": 0.1, "coulomb": 0.1, "breakaway": 0.2},
}
PUSH = [{"kind": "push", "at": 0.0, "duration": 10.0, "torque": [0.5, -0.3]}]
OUTSIDE = '''
class Faulty:
    """A PD law that gives one bad torque, or a hook that makes one bad reading or torque."""

    def __init__(self, setup, at, value):
        self.at, self.value, self.tick, self.dt = at, value, 0, setup.dt

    def update(self, inputs):
        tau = -574.0 * (inputs.q - inputs.q_ref) - 153.0 * (inputs.qd - inputs.qd_ref)
        if self.tick == self.at:
            tau[1] = float(self.value)
        self.tick += 1
        return tau


class Sensed(Faulty):
    def sense(self, t, x):
        if round(t / self.dt) == self.at:
            x[2] = float(self.value)
        return x


class Clipped(Faulty):
    """Would hide an infinite command."""

    def actuate(self, t, tau):
        return tau.clip(-50.0, 50.0)
'''
# Each alone is allowed; what comes of it must end as divergence, or stay finite to the end.
WILD = (
    "controller={kind: pd, K_p: 1.0e+300}",
    "controller={kind: pd, K_d: 1.0e+200}",
    "imperfections.friction.viscous=1.0e+300",
    "imperfections.friction.coulomb=1.0e+300",
    "imperfections.position_noise=1.0e+300",
    "imperfections.velocity_bias=1.0e+300",
    "imperfections.velocity_bias=-1.0e+160",
    "imperfections.position_bias=1.0e+300",
    "events=[{kind: push, at: 0.01, duration: 0.1, torque: [1.0e+300, 0.0]}]",
    "events=[{kind: push, at: 0.01, duration: 0.1, torque: [9.9e+8, -9.9e+8]}]",
    "events=[{kind: push, at: 0.01, duration: 0.1, force: [1.0e+308, 1.0e+308]}]",
    "events=[{kind: payload, at: 0.01, mass: 1.0e+300}]",
    "initial.qd=1.0e+300",
    "initial.q=[1.0e+300, 0.0]",
    "initial.qd=[900.0, -900.0]",
    "reference.amplitude=1.0e+300",
    "reference.frequency=1.0e+200",
    "controller.madam.sigma_max=1.0e+38",
    "controller.network.init_scale=1000.0",
    "plant.masses=[1.0e-8, 1.0e+8]",
    "plant.lengths=[1.0e+150, 1.0]",
    "plant.gravity=1.0e+300",
)


def run(form: Form, tally: Tally, folder: Path) -> None:
    """All of it, in two processes where it is long."""
    rng = np.random.default_rng(form.seed)
    kinds = controller_kinds() if form.long else SHORT_KINDS
    total = form.pick(60, 1000)
    jobs = [
        Job(kind, variant, total // (2 * len(kinds)) + 1, int(rng.integers(2**31)))
        for kind in kinds
        for variant in ("plain", "imperfect")
    ]
    if form.long:
        jobs.append(Job("dnn_mso", "torch", 8, int(rng.integers(2**31))))
        with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
            found = list(pool.map(strike_all, jobs))
    else:
        found = list(map(strike_all, jobs))
    for lost, survived in found:
        tally.survive(survived)
        for what in lost:
            tally.lose(what)
    tally.figure("faults put into logged runs", sum(len(lost) + good for lost, good in found))
    _scenarios(form, tally)
    _command_line(form, tally, folder, rng)
    _environments(form, tally, rng)


@dataclass(frozen=True)
class Job:
    """Some faults of one controller.

    Args:
        kind: of controller.
        variant: "plain", "imperfect" or "torch".
        count: how many.
        seed: of where and when.
    """

    kind: str
    variant: str
    count: int
    seed: int

    def scenario(self) -> Scenario:
        """A quarter of a second."""
        parts: dict[str, Any] = {}
        spec: dict[str, Any] = {"kind": self.kind}
        if self.variant == "torch":
            spec["network"] = {"backend": "torch", "hidden": [8, 8, 8]}
        if self.variant == "imperfect":
            parts = {"imperfections": IMPERFECT, "events": PUSH}
        return Scenario(
            name=self.kind,
            controller=spec,
            reference={"kind": "sinusoid", "phase": [0.0, 1.5]},
            duration=DURATION,
            seed=self.seed % 1000,
            **parts,
        )

    def faults(self, simulation: Simulation) -> Iterator[Fault]:
        """Places that this run has, in turn; ticks, values and entries at random."""
        rng = np.random.default_rng(self.seed)
        kept = places(simulation.controller.state())
        where = ["force", "state", *(name for name, arrays in kept.items() if arrays)]
        if self.variant == "imperfect":
            where += ["sensor", "torque"]
        if kept["optimiser"] and hasattr(getattr(simulation.controller, "learner", None), "net"):
            where.append("gradient")
        offset = int(rng.integers(len(where)))
        for k in range(self.count):
            yield Fault(
                where[(k + offset) % len(where)],
                int(rng.integers(simulation.scenario.n_ticks)),
                VALUES[int(rng.integers(len(VALUES)))],
                float(rng.random()),
            )


def strike_all(job: Job) -> tuple[list[str], int]:
    """What of a job's faults was lost, and how many were not."""
    mjcf = Mjcf.read(find_model("two_link"))
    simulation, tally = Simulation(job.scenario(), mjcf), Tally()
    with tempfile.TemporaryDirectory(prefix="dnnmso-faults-") as name:
        folder = Path(name)
        clean = run_struck(simulation, mjcf, None, folder / "clean.mcap").run.trace
        assert clean.info.status == "ok", clean.info.reason
        for k, fault in enumerate(job.faults(simulation)):
            out = folder / f"{k}.mcap"
            with tally.case(f"{job}, {fault}"):
                check(run_struck(simulation, mjcf, fault, out), clean)
            out.unlink(missing_ok=True)
    return tally.lost, tally.survived


def _scenarios(form: Form, tally: Tally) -> None:
    """Scenarios that make what is not finite by themselves, or nearly."""
    for text in WILD:
        with tally.case(f"--set {text}"):
            check_wild(text)


def check_wild(text: str) -> None:
    """It is refused, or ends finite, or ends as divergence; MuJoCo is given nothing else."""
    from dnnmso_mj.errors import ScenarioError

    kind = "no_network" if "network" not in text and "madam" not in text else "dnn_mso"
    sets = [text, "duration=0.1"]
    try:
        own = None if text.startswith("controller=") else kind
        scenario = load_scenario("paper", sets, **({"controller": own} if own else {}))
    except ScenarioError:
        return
    with witness() as seen:
        try:
            trace = simulate(scenario)
        except ScenarioError:
            return
    assert all(np.isfinite(trace[name]).all() for name in trace), "not finite in a row"
    assert trace.info.status == "diverged" or len(trace) == scenario.n_ticks
    assert not seen.bad, f"MuJoCo was given {seen.bad[0]}"


def _command_line(form: Form, tally: Tally, folder: Path, rng: np.random.Generator) -> None:
    """Exit status, message and log of real commands, by code from outside."""
    (folder / "laws.py").write_text(OUTSIDE)
    cases = [
        ("Faulty", "nan", "tau = ["),
        ("Sensed", "inf", "Sensed.sense = ["),
        ("Clipped", "inf", "tau_cmd = ["),
        ("Faulty", "1e300", "tau = ["),
        ("Faulty", "-inf", "tau = ["),
        ("Sensed", "nan", "Sensed.sense = ["),
        ("Clipped", "nan", "tau_cmd = ["),
    ]
    for number, (name, value, said) in enumerate(cases[: form.pick(3, len(cases))]):
        tick, out = int(rng.integers(1, 200)), folder / f"{number}.mcap"
        with tally.case(f"dnnmso run with {name} giving {value} in tick {tick}"):
            _check_command(folder, out, name, value, said, tick)


def _check_command(folder: Path, out: Path, name: str, value: str, said: str, tick: int) -> None:
    spec = {"python": f"laws.py:{name}", "settings": {"at": tick, "value": value}}
    late = spec | {"settings": {"at": tick if name == "Clipped" else -1, "value": value}}
    law = {"kind": "external"} | (late if name == "Sensed" else spec)
    if name == "Clipped":
        law["python"] = "laws.py:Faulty"
    sets = [f"controller={json.dumps(law)}", "duration=0.2"]
    if name != "Faulty":
        sets.append(f"imperfections.external=[{json.dumps(spec)}]")
    words = [word for text in sets for word in ("--set", text)]
    ended = dnnmso(
        "run", "paper", *words, "--trust", "--json", "--no-plot", "--out", out, cwd=folder
    )
    assert ended.status == 1, f"status {ended.status}: {ended.err}"
    assert "Traceback" not in ended.err
    told = json.loads(ended.out)
    info, trace = log_info(out), read_trace(out)
    assert (told["status"], info.status, info.complete) == ("diverged", "diverged", True)
    assert said in info.reason, info.reason
    assert info.reason.endswith(f"at t = {tick * 0.001:.6g} s"), info.reason
    assert f"diverged: {info.reason}" in ended.err
    assert (info.events[-1].level, info.events[-1].message) == ("error", f"diverged: {info.reason}")
    assert len(trace) == info.ticks == tick
    assert all(np.isfinite(trace[column]).all() for column in trace)
    last = read_snapshots(out)[-1]
    assert (last.name, round(last.t / 0.001)) == ("controller", tick)


def _environments(form: Form, tally: Tally, rng: np.random.Generator) -> None:
    """Bad actions and bad states, in both faces of an environment."""
    try:
        from dnnmso_mj.environments import dm
        from dnnmso_mj.environments.gym import TrackingEnv
    except ImportError as error:
        tally.leave_out("environments", str(error))
        return
    env = TrackingEnv("paper", ("duration=0.2",))
    other = dm.load("paper", ("duration=0.2",))
    for _ in range(form.pick(4, 30)):
        tick, value = int(rng.integers(1, 200)), VALUES[int(rng.integers(3))]
        where = ("action", "state")[int(rng.integers(2))]
        with tally.case(f"gym: {value} as {where} in tick {tick}"), witness() as seen:
            check_gym(env, where, tick, value)
            assert not seen.bad, seen.bad
        with tally.case(f"dm: {value} as {where} in tick {tick}"), witness() as seen:
            check_dm(other, where, tick, value)
            assert not seen.bad, seen.bad


def check_gym(env: Any, where: str, tick: int, value: float) -> None:
    """The episode ends there, as terminated, and says why; nothing it gives is not finite."""
    env.reset(seed=1)
    for k in range(200):
        action = np.zeros(2)
        if k == tick and where == "action":
            action[1] = value
        if k == tick - 1 and where == "state":
            env.episode.plant.data.qvel[0] = value
        observation, reward, terminated, truncated, info = env.step(action)
        assert np.isfinite(observation).all(), "an observation that is not finite"
        assert np.isfinite(reward), "a reward that is not finite"
        if terminated or truncated:
            break
    _check_episode(env.episode, where, tick)
    assert terminated, "not terminated"
    assert (info["status"], info["metrics"]["diverged"]) == ("diverged", True)


def check_dm(env: Any, where: str, tick: int, value: float) -> None:
    """The same of dm_control's face."""
    step = env.reset()
    for k in range(200):
        action = np.zeros(2)
        if k == tick and where == "action":
            action[1] = value
        if k == tick - 1 and where == "state":
            env.task._episode.plant.data.qvel[0] = value
        step = env.step(action)
        seen = np.concatenate(list(step.observation.values()))
        assert np.isfinite(seen).all(), "an observation that is not finite"
        if step.last():
            break
    _check_episode(env.task._episode, where, tick)
    assert (step.discount, step.reward) == (0.0, 0.0)


def _check_episode(episode: Any, where: str, tick: int) -> None:
    trace = episode.trace()
    assert trace.info.status == "diverged", trace.info.status
    assert tick - 1 <= len(trace) <= tick, f"{len(trace)} ticks, the fault was in {tick}"
    assert all(np.isfinite(trace[name]).all() for name in trace)
    name = "tau = [" if where == "action" else "q"
    assert trace.info.reason.startswith(name), trace.info.reason
