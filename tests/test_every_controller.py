"""What holds of every controller: the union of scenarios is what these tests go over."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from dnnmso_mj.controllers import MODEL_FROZEN, Inputs, build_controller, compiled_ticks
from dnnmso_mj.difference import difference
from dnnmso_mj.loading import controller_kinds
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.plots import run_figures
from dnnmso_mj.reading import read_snapshots, read_trace
from dnnmso_mj.resume import resume
from dnnmso_mj.run import run_logged
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.scenario.controller import inversion
from dnnmso_mj.scene import Scene
from dnnmso_mj.simulation import Simulation
from dnnmso_mj.trace import Trace

KINDS = pytest.mark.parametrize("kind", controller_kinds())
CLOCKED = {"compute_us", "deadline_missed", "wake_late_us"}
LEARNED = {  # what may not be lost when a run begins anew, by its name in a controller's state
    "weights", "mean_weights", "second_moment", "updates", "theta", "W", "V", "centres",
    "stack_Y", "stack_U", "stack_age",
}  # fmt: skip
IMPERFECT = {
    "torque_limit": 60.0,
    "torque_rate": 5000.0,
    "actuator_lag": 0.004,
    "actuator_delay": 0.0023,
    "sensor_delay": 0.0017,
    "jitter": 0.001,
    "position_noise": 1e-4,
    "velocity_noise": 1e-3,
    "position_bias": 1e-3,
    "velocity_drift": 1e-3,
    "encoder_counts": 65536,
    "friction": {"viscous": 0.1, "coulomb": 0.1, "breakaway": 0.2},
}
HAPPENINGS = [
    {"kind": "payload", "at": 0.1, "mass": 0.5},
    {"kind": "push", "at": 0.2, "duration": 0.1, "torque": [5.0, 0.0]},
    {"kind": "freeze", "at": 0.4, "what": "model"},
]


def imperfect(kind: str) -> Scenario:
    """Half a second of everything that can be wrong; an observer hears of the torque that acted."""
    return Scenario(
        name=kind,
        controller=heard(kind),
        reference={"kind": "sinusoid", "phase": [0.0, 1.5]},
        imperfections=IMPERFECT,
        events=HAPPENINGS,
        duration=0.5,
    )


def heard(kind: str) -> dict:
    spec = Scenario(name="x", controller={"kind": kind}, reference={"kind": "sinusoid"}).controller
    told = hasattr(getattr(spec, "observer", None), "torque")
    return {"kind": kind, **({"observer": {"torque": "applied"}} if told else {})}


class Wrapped:
    """A controller that keeps its law but not its compiled ticks."""

    def __init__(self, controller) -> None:
        self._controller = controller
        self.n_layers = controller.n_layers

    def __getattr__(self, name):
        return getattr(self._controller, name)

    def update(self, inputs):
        return self._controller.update(inputs)


@cache
def arm() -> Mjcf:
    return Mjcf.read(find_model("two_link"))


def run(simulation: Simulation) -> Trace:
    recorder = MemoryRecorder(simulation.layout, simulation.scenario.n_ticks)
    return recorder.trace(simulation.scenario, simulation.run(recorder))


@cache
def compiled_run(kind: str) -> Trace:
    return run(Simulation(imperfect(kind), arm()))


def check_same(one: Trace, other: Trace) -> None:
    assert len(one) == len(other)
    for name in set(one) - CLOCKED:
        assert np.array_equal(one[name], other[name], equal_nan=True), name


def chance(seed: int, count: int) -> list[Inputs]:
    """Inputs of all kinds, the torque that acted among them."""
    rng = np.random.default_rng(seed)
    draws = zip(rng.normal(size=(count, 3, 4)), rng.normal(0, 9, size=(count, 2)), strict=True)
    return [Inputs(x, tau, r, rd, np.zeros(1, np.int64)) for (x, r, rd), tau in draws]


@KINDS
def test_interpreted_and_compiled_loop_give_the_same_run(kind):
    simulation = Simulation(imperfect(kind), arm())
    assert compiled_ticks(simulation.controller) is not None
    simulation.controller = Wrapped(simulation.controller)
    assert compiled_ticks(simulation.controller) is None
    interpreted = run(simulation)
    assert interpreted.info.status == "ok"
    check_same(interpreted, compiled_run(kind))


@KINDS
def test_a_simulation_run_again_is_the_same_run(kind):
    simulation = Simulation(imperfect(kind), arm())
    check_same(run(simulation), compiled_run(kind))
    check_same(run(simulation), compiled_run(kind))


@KINDS
def test_a_restored_controller_goes_on_as_the_one_whose_state_it_was(kind):
    scenario = imperfect(kind)
    one, other = (
        build_controller(scenario.model_copy(update={"seed": seed}), arm()) for seed in (0, 9)
    )
    for controller, seed in ((one, 1), (other, 2)):
        controller.reset(np.full(4, 0.1 * seed))
        for inputs in chance(seed, 150):
            controller.update(inputs)
    state = one.state()
    kept = {name: values.copy() for name, values in state.items()}
    other.restore(state)
    for inputs in chance(3, 150):
        expected = one.update(inputs)
        for here, there in zip(expected[:5], other.update(inputs)[:5], strict=True):
            assert np.array_equal(here, there)
    assert all(np.array_equal(state[name], kept[name]) for name in kept)  # a copy, not a view


@KINDS
def test_to_begin_anew_after_restoring_keeps_what_was_learned_and_forgets_the_rest(kind):
    one, other = (build_controller(imperfect(kind), arm()) for _ in range(2))
    x = np.array([0.3, -0.4, 0.5, 0.6])
    one.reset(x)
    for inputs in chance(1, 150):
        one.update(inputs)
    state = one.state()
    other.restore(state)
    other.reset(x)
    for name in LEARNED & set(state):
        assert np.array_equal(other.state()[name], state[name]), name
    assert np.array_equal(other.dynamics(x), one.dynamics(x))
    for inputs in chance(4, 2):
        inputs.frozen[0] = MODEL_FROZEN
        one.update(inputs)
    one.reset(x)
    for inputs in chance(5, 3):
        expected = one.update(inputs)
        for here, there in zip(expected[:5], other.update(inputs)[:5], strict=True):
            assert np.array_equal(here, there)


@KINDS
def test_a_log_says_what_was_run_and_can_be_drawn_replayed_and_resumed(kind, tmp_path: Path):
    from dnnmso_mj.viewer.rrd import Run, rrd_bytes  # not at collection: an optional library

    logged = run_logged(imperfect(kind), tmp_path / "run.mcap")
    trace = read_trace(logged.log)
    check_same(trace, compiled_run(kind))
    assert trace.scenario == imperfect(kind)
    snapshots = read_snapshots(logged.log)
    state = next(s for s in reversed(snapshots) if s.name == "controller").arrays
    assert set(state) == set(build_controller(imperfect(kind), arm()).state())
    assert trace.info.metrics["diverged"] is False
    assert (trace.info.metrics["bound_violations"] is None) == (
        inversion(trace.scenario.controller) is None
    )
    figures = run_figures(trace)
    assert ("learning" in figures) == bool(trace.n_layers)
    for figure in figures.values():
        figure.canvas.draw()
    resumed = resume(logged.log, 0.237, out=tmp_path / "resumed.mcap").run.log
    assert difference(logged.log, resumed).equal
    scene = Scene(Simulation(imperfect(kind), arm()).plant.model)
    assert rrd_bytes([Run(kind, trace, scene, snapshots)])[:3] == b"RRF"
