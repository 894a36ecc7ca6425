"""All imperfections and events at once: one run, however it is cut up, and none by default."""

from __future__ import annotations

import numpy as np
import pytest

from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.simulation import Simulation, simulate
from dnnmso_mj.trace import Trace

CLOCKED = {"compute_us", "deadline_missed", "wake_late_us"}
EVERYTHING = {
    "imperfections": {
        "torque_limit": 150.0,
        "torque_rate": 2e4,
        "actuator_lag": 0.001,
        "actuator_delay": 0.0007,
        "sensor_delay": 0.0004,
        "jitter": 0.0005,
        "position_noise": 1e-5,
        "position_bias": [1e-3, 0.0],
        "position_drift": 1e-4,
        "encoder_counts": 100_000,
        "velocity_from": "difference",
        "velocity_filter": 0.005,
        "friction": {"viscous": 0.5, "coulomb": 1.0, "breakaway": 2.0},
    },
    "events": [
        {"kind": "push", "at": 0.2003, "duration": 0.1, "torque": [3.0, -1.0], "force": [1, 2, 3]},
        {"kind": "payload", "at": 0.7, "mass": 0.5},
    ],
    "duration": 1.3,
    "seed": 3,
}


class Wrapped:
    """A controller that keeps its law but not its compiled ticks."""

    def __init__(self, controller) -> None:
        self._controller = controller
        self.n_layers = controller.n_layers

    def __getattr__(self, name):
        return getattr(self._controller, name)

    def update(self, inputs):
        return self._controller.update(inputs)


def recorded(simulation: Simulation, block: int = 250) -> Trace:
    recorder = MemoryRecorder(simulation.layout, simulation.scenario.n_ticks)
    recorder.block = block
    return recorder.trace(simulation.scenario, simulation.run(recorder))


def assert_same(one: Trace, other: Trace) -> None:
    assert one.events == other.events
    for name in set(one) - CLOCKED:
        assert np.array_equal(one[name], other[name]), name


@pytest.fixture
def simulation(make_scenario, two_link) -> Simulation:
    return Simulation(make_scenario({"kind": "no_network"}, **EVERYTHING), two_link)


def test_everything_at_once_is_one_run_however_it_is_cut_up(simulation):
    whole = recorded(simulation)
    assert whole.info.status == "ok"
    assert len(whole.events) >= 3
    assert_same(whole, recorded(simulation, block=7))
    assert_same(whole, recorded(simulation))


def test_everything_at_once_is_the_same_interpreted_and_compiled(simulation):
    compiled = recorded(simulation)
    simulation.controller = Wrapped(simulation.controller)
    assert_same(compiled, recorded(simulation))


def test_another_seed_is_another_run_even_without_a_network(simulation, make_scenario, two_link):
    other = Simulation(make_scenario({"kind": "no_network"}, **EVERYTHING | {"seed": 4}), two_link)
    assert not np.array_equal(recorded(simulation)["q_meas"], recorded(other)["q_meas"])


def test_by_default_nothing_is_imperfect(make_scenario, two_link):
    world = Simulation(make_scenario(), two_link).stage.world
    assert world.sensors.perfect
    assert world.actuators.prompt
    assert not world.loads.acting


@pytest.mark.parametrize(
    "spec",
    [
        {"position_bias": 1e-3},
        {"velocity_drift": 1e-3},
        {"sensor_delay": 1e-4},
        {"encoder_counts": 1000},
        {"velocity_from": "difference"},
        {"actuator_lag": 1e-3},
        {"actuator_delay": 1e-4},
        {"friction": {"breakaway": 1.0}},
    ],
)
def test_each_imperfection_alone_changes_the_run(make_scenario, spec):
    off = {"kind": "no_network"}
    scenario = make_scenario(off, duration=0.2, imperfections=spec)
    assert not np.array_equal(
        simulate(scenario)["q"], simulate(make_scenario(off, duration=0.2))["q"]
    )


@pytest.mark.parametrize(
    "spec",
    [
        {"torque_limit": 60.0, "torque_rate": 2e3},
        {"actuator_delay": 0.0025},
        {"actuator_lag": 0.005},
        {"position_noise": 1e-3, "velocity_noise": 1e-2},
        {"velocity_from": "difference", "encoder_counts": 10_000, "velocity_filter": 0.005},
    ],
)
def test_the_bound_holds_whatever_separates_command_and_arm(make_scenario, spec):
    """It is driven by what the arm does, so it holds; it is only wider."""
    trace = simulate(make_scenario({"kind": "no_network"}, duration=3.0, imperfections=spec))
    assert trace.info.status == "ok"
    assert compute_metrics(trace)["bound_violations"] == 0
