"""Sensors: what they say against closed forms, and random streams that nothing else disturbs."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from dnnmso_mj.imperfections.sensors import SensorBank, sense
from dnnmso_mj.scenario import Imperfections
from dnnmso_mj.simulation import simulate

DT = 1e-3
QUIET = {"position_noise": 1e-4, "velocity_noise": 1e-3}


def readings(states: np.ndarray, chunk: int = 100, seed: int = 0, **spec: Any) -> np.ndarray:
    """What the sensors say of states (N, 2n), one a tick."""
    bank = SensorBank(Imperfections(**spec), states.shape[1] // 2, DT, seed, chunk)
    bank.start(states[0])
    out = np.zeros_like(states)
    for k, x in enumerate(states):
        if k % chunk == 0:
            bank.draw()
        sense(bank.view, x, k, k % chunk, out[k])
    return out


def smooth(n_ticks: int) -> np.ndarray:
    t = np.arange(n_ticks) * DT
    return np.stack([np.sin(9 * t), np.cos(4 * t), 9 * np.cos(9 * t), -4 * np.sin(4 * t)], axis=1)


def still(n_ticks: int) -> np.ndarray:
    return np.zeros((n_ticks, 4))


def test_perfect_sensors_say_what_is():
    assert np.array_equal(readings(smooth(300)), smooth(300))


@pytest.mark.parametrize("delay", [0.004, 0.0037])
def test_a_delay_shows_the_past_and_before_the_start_the_initial_state(delay):
    states = smooth(300)
    t = np.arange(300)
    expected = [np.interp(t - delay / DT, t, column) for column in states.T]
    assert np.allclose(readings(states, sensor_delay=delay), np.transpose(expected), atol=1e-12)


def test_jitter_makes_each_reading_older_by_up_to_its_bound():
    ramp = np.arange(4000)[:, None] * DT * np.ones(4)
    ages = (ramp - readings(ramp, sensor_delay=0.002, jitter=0.003))[10:]
    assert np.allclose(ages, ages[:, :1])  # one age for the whole reading
    assert 0.002 <= ages.min() < 0.0021
    assert 0.0049 < ages.max() <= 0.005
    assert ages.mean() == pytest.approx(0.0035, abs=4 * 0.003 / np.sqrt(12 * 3990))


def test_bias_and_white_noise_have_their_mean_and_spread():
    said = readings(still(20_000), position_noise=[1e-4, 0.0], position_bias=[0.0, 0.2],
                    velocity_noise=1e-3, velocity_bias=-0.1)  # fmt: skip
    assert np.allclose(said.mean(axis=0), [0.0, 0.2, -0.1, -0.1], atol=4 * 1e-3 / np.sqrt(20_000))
    assert np.allclose(said.std(axis=0), [1e-4, 0.0, 1e-3, 1e-3], rtol=0.03)
    lag_one = np.corrcoef(said[1:, 0], said[:-1, 0])[0, 1]
    assert abs(lag_one) < 4 / np.sqrt(20_000)


def test_drift_is_a_random_walk_that_starts_at_zero():
    said = readings(still(20_000), position_drift=0.01, velocity_drift=[0.0, 0.2])
    assert not said[0].any()
    assert not said[:, 2].any()
    steps = np.diff(said[:, [0, 1, 3]], axis=0)
    assert np.allclose(steps.std(axis=0), np.array([0.01, 0.01, 0.2]) * np.sqrt(DT), rtol=0.03)
    assert np.abs(np.corrcoef(steps.T)[np.triu_indices(3, 1)]).max() < 4 / np.sqrt(20_000)


def test_an_encoder_rounds_angles_to_its_steps_and_nothing_else():
    states = smooth(500)
    said = readings(states, encoder_counts=[1000, 64])
    steps = 2 * np.pi / np.array([1000, 64])
    assert np.array_equal(said[:, 2:], states[:, 2:])
    assert np.abs(said[:, :2] - states[:, :2]).max(axis=0) == pytest.approx(steps / 2, rel=0.1)
    counts = said[:, :2] / steps
    assert np.allclose(counts, np.round(counts), atol=1e-9)


def test_noise_comes_before_the_encoders_steps():
    said = readings(still(2000), encoder_counts=1000, position_noise=0.01)[:, 0]
    counts = said / (2 * np.pi / 1000)
    assert np.allclose(counts, np.round(counts), atol=1e-9)
    assert len(np.unique(np.round(counts))) > 5


@pytest.mark.parametrize("smoothing", [0.0, 0.02])
def test_velocity_by_difference_is_the_filtered_difference_of_the_angles_read(smoothing):
    said = readings(
        smooth(400), encoder_counts=4096, velocity_from="difference", velocity_filter=smoothing
    )
    decay = np.exp(-DT / smoothing) if smoothing else 0.0
    v = np.zeros(2)
    for before, now in pairwise(said):
        v = decay * v + (1 - decay) * (now[:2] - before[:2]) / DT
        assert np.allclose(now[2:], v, atol=1e-9)
    assert not said[0, 2:].any()


def test_the_filtered_difference_of_a_ramp_rises_as_a_first_order_lag_does():
    ramp = np.arange(200)[:, None] * DT * np.array([1.0, 2.0, 0.0, 0.0])
    said = readings(ramp, velocity_from="difference", velocity_filter=0.03)
    rise = 1 - np.exp(-np.arange(200) * DT / 0.03)
    assert np.allclose(said[:, 2:], rise[:, None] * [1.0, 2.0], atol=1e-9)


def test_what_is_drawn_does_not_depend_on_how_much_is_drawn_at_once():
    spec = QUIET | {"position_drift": 0.1, "velocity_drift": 0.1, "jitter": 0.002}
    one, other = (readings(smooth(300), chunk=chunk, **spec) for chunk in (100, 7))
    assert np.array_equal(one, other)
    assert not np.array_equal(one, readings(smooth(300), seed=1, **spec))


def test_each_source_has_its_own_stream():
    alone = readings(still(300), position_noise=1e-4)[:, :2]
    among = readings(still(300), **QUIET, position_drift=1e-9, jitter=0.01)[:, :2]
    assert np.allclose(alone, among, atol=1e-8)
    walk = readings(still(300), position_drift=1.0)[:, :2]
    correlation = np.corrcoef(np.diff(walk, axis=0)[:, 0], alone[:-1, 0])[0, 1]
    assert abs(correlation) < 4 / np.sqrt(300)


def test_the_log_shows_what_the_sensors_said_and_what_was(make_scenario):
    scenario = make_scenario({"kind": "no_network"}, duration=2.5, imperfections=QUIET)
    trace = simulate(scenario)
    error = np.hstack([trace["q_meas"] - trace["q"], trace["qd_meas"] - trace["qd"]])
    assert np.allclose(error.std(axis=0), [1e-4, 1e-4, 1e-3, 1e-3], rtol=0.06)
    assert np.array_equal(trace["x_hat"][0], [*trace["q_meas"][0], *trace["qd_meas"][0]])
    perfect = simulate(make_scenario({"kind": "no_network"}, duration=0.1))
    assert np.array_equal(perfect["q_meas"], perfect["q"])


def test_the_same_seed_pairs_the_noise_of_different_controllers(make_scenario):
    errors = []
    for controller in ({"kind": "no_network"}, {"kind": "dnn_mso"}):
        trace = simulate(make_scenario(controller, duration=1.5, seed=5, imperfections=QUIET))
        errors.append(np.hstack([trace["q_meas"] - trace["q"], trace["qd_meas"] - trace["qd"]]))
    assert np.allclose(*errors, atol=1e-12)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ({"velocity_filter": 0.1}, "allowed: 0 unless velocity_from is difference"),
        ({"velocity_from": "difference", "velocity_noise": 1.0}, "is of a velocity sensor"),
        ({"sensor_delay": 1.5}, "less than or equal to 1"),
        ({"encoder_counts": 0}, "greater than or equal to 1"),
        ({"encoder_counts": 0.5}, "valid integer"),
        ({"position_noise": -1e-4}, "greater than or equal to 0"),
        ({"jitter": -1e-4}, "greater than or equal to 0"),
    ],
)
def test_impossible_sensors_are_refused(spec, message):
    with pytest.raises(ValueError, match=message):
        Imperfections(**spec)
