"""Drives: limits, rate, delay and lag, each against its exact solution."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dnnmso_mj.dynamics import TwoLink
from dnnmso_mj.imperfections.actuators import actuate, build_actuators, split
from dnnmso_mj.scenario import Imperfections
from dnnmso_mj.simulation import simulate

DT = 1e-3
FINE = 1000  # parts of a period in the brute-force solutions


def driven(commands: np.ndarray, **spec: Any) -> tuple[np.ndarray, np.ndarray]:
    """Torques (N, n) that act, and whether a limit did, for commands (N, n)."""
    actuators = build_actuators(Imperfections(**spec), commands.shape[1], DT)
    tau, saturated = np.zeros_like(commands), np.zeros(len(commands), bool)
    for k, command in enumerate(commands):
        saturated[k] = actuate(actuators, command, k)
        tau[k] = actuators.tau
    return tau, saturated


def commands(n_ticks: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, 10.0, size=(n_ticks, 2)).cumsum(axis=0)


def steps(n_ticks: int) -> np.ndarray:
    return np.ones((n_ticks, 1))


def test_without_imperfections_the_command_acts():
    tau, saturated = driven(commands(50))
    assert np.array_equal(tau, commands(50))
    assert not saturated.any()


def test_the_rate_limit_is_a_ramp_from_rest():
    tau, saturated = driven(steps(30), torque_rate=100.0)
    assert np.allclose(tau[:, 0], np.minimum(0.1 * np.arange(1, 31), 1.0), atol=1e-12)
    assert saturated[:9].all()
    assert not saturated[10:].any()


@pytest.mark.parametrize("late", [{}, {"actuator_delay": 0.0026, "actuator_lag": 0.004}])
def test_torque_and_its_change_stay_within_their_limits(late):
    tau, saturated = driven(commands(2000), torque_limit=[60.0, 20.0], torque_rate=4e3, **late)
    assert np.all(np.abs(tau) <= np.array([60.0, 20.0]) * (1 + 1e-12))
    assert np.abs(np.diff(tau, axis=0, prepend=0.0)).max() <= 4.0 * (1 + 1e-9)
    assert np.abs(tau).max(axis=0) == pytest.approx([60.0, 20.0])
    assert 0 < saturated.sum() < 2000


@pytest.mark.parametrize("periods", [1, 5, 20])
def test_a_whole_delay_shifts_the_command(periods):
    tau, _ = driven(commands(100), actuator_delay=periods * DT)
    assert np.array_equal(tau[periods:], commands(100)[:-periods])
    assert not tau[:periods].any()


@pytest.mark.parametrize("delay", [0.0003, 0.0026])
def test_a_fraction_of_a_period_is_the_mean_of_the_old_and_the_new_command(delay):
    fine = np.repeat(commands(100), FINE, axis=0)
    shifted = np.zeros_like(fine)
    late = round(delay / DT * FINE)
    shifted[late:] = fine[:-late]
    mean = shifted.reshape(100, FINE, 2).mean(axis=1)
    assert np.allclose(driven(commands(100), actuator_delay=delay)[0], mean, atol=1e-10)


def test_the_lag_of_a_step_has_the_mean_of_the_exact_answer_in_each_period():
    lag = 0.005
    ends = np.arange(41) * DT
    integral = ends + lag * np.exp(-ends / lag)  # of 1 − exp(−t/T)
    tau, _ = driven(steps(40), actuator_lag=lag)
    assert np.allclose(tau[:, 0], np.diff(integral) / DT, atol=1e-12)


def test_lag_after_a_fractional_delay_is_solved_through_both_parts_of_a_period():
    lag, delay = 0.004, 0.0026
    tau, _ = driven(steps(60), actuator_lag=lag, actuator_delay=delay)
    t = np.linspace(0.0, 0.06, 60 * 2000 + 1)
    since = np.maximum(t - delay, 0.0)
    integral = since - lag * (1 - np.exp(-since / lag))
    assert np.allclose(tau[:, 0], np.diff(integral[::2000]) / DT, atol=1e-12)


def test_a_lag_much_shorter_than_a_period_hardly_matters():
    tau, _ = driven(commands(50), actuator_lag=1e-9)
    assert np.allclose(tau, commands(50), atol=1e-3)


def test_a_delay_that_is_whole_but_for_rounding_is_whole():
    assert split(0.02 / 0.001) == (20, 0.0)
    assert split(0.3 / 0.1) == (3, 0.0)
    assert split(0.25) == (0, 0.25)
    assert split(2.5) == (2, 0.5)


def test_the_log_and_the_controller_are_told_the_torque_that_acted(make_scenario):
    spec = {"torque_limit": 60.0, "actuator_delay": 0.003}
    trace = simulate(make_scenario({"kind": "no_network"}, duration=0.3, imperfections=spec))
    clamped = np.clip(trace["tau_cmd"], -60.0, 60.0)
    assert np.array_equal(trace["tau"][3:], clamped[:-3])
    assert np.array_equal(trace["saturated"], (clamped != trace["tau_cmd"]).any(axis=1))


def test_with_late_torques_the_true_dynamics_are_still_those_of_the_arm(make_scenario):
    spec = {"actuator_delay": 0.0015, "actuator_lag": 0.002, "position_noise": 1e-3}
    trace = simulate(make_scenario({"kind": "no_network"}, duration=0.3, imperfections=spec))
    q, qd = trace["q"], trace["qd"]
    free = TwoLink((1.0, 2.3), (1.0, 1.0)).acceleration(q, qd, np.zeros_like(q))
    assert np.allclose(trace["f_true"][:, 2:], free, rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize(
    "spec", [{"torque_rate": 0.0}, {"actuator_lag": -1.0}, {"actuator_delay": 1.01}]
)
def test_impossible_drives_are_refused(spec):
    with pytest.raises(ValueError, match=next(iter(spec))):
        Imperfections(**spec)
