"""References: derivatives are derivatives, and the corners are where they should be."""

from __future__ import annotations

import numpy as np
import pytest

from dnnmso_mj.reference import Reference
from dnnmso_mj.scenario import ExpSinusoid, Setpoint, Sinusoid, Waypoints

PAPER = Sinusoid(kind="sinusoid", phase=[0.0, np.pi / 2])
SPECS = {
    "sinusoid": Sinusoid(
        kind="sinusoid", amplitude=[0.3, 2.0], frequency=[2.0, 0.7], phase=[0.1], offset=[0.5]
    ),
    "exp_sinusoid": ExpSinusoid(
        kind="exp_sinusoid", amplitude=[0.3, 2.0], frequency=[2.0, 0.7], phase=[0.1, 1.0]
    ),
    "setpoint": Setpoint(
        kind="setpoint", start=[0.5, -1.0], goal=[1.5, 0.0], start_time=0.5, blend_time=2.0
    ),
    "waypoints": Waypoints(
        kind="waypoints", times=[0.5, 1.0, 2.5, 3.0], points=[[0, 0], [1, -1], [0.5, 2], [0, 1]]
    ),
}


@pytest.mark.parametrize("kind", SPECS)
def test_velocity_and_acceleration_are_the_derivatives(kind):
    reference, h = Reference(SPECS[kind], 2), 1e-5
    t = np.linspace(0, 4, 401) + 3e-4  # away from the corners of the third derivative
    q, qd, qdd = reference.sample(t)
    before, after = reference.sample(t - h), reference.sample(t + h)
    assert q.shape == qd.shape == qdd.shape == (401, 2)
    assert np.allclose(qd, (after[0] - before[0]) / (2 * h), atol=1e-6)
    assert np.allclose(qdd, (after[1] - before[1]) / (2 * h), atol=1e-4)


def test_paper_reference_is_a_sine_and_a_cosine():
    t = np.linspace(0, 10, 101)
    q, qd, _ = Reference(PAPER, 2).sample(t)
    assert np.allclose(q, np.stack([np.sin(0.5 * t), np.cos(0.5 * t)], 1), atol=1e-15)
    assert np.allclose(qd[:, 1], -0.5 * np.sin(0.5 * t), atol=1e-15)


def test_setpoint_rests_at_both_ends_and_peaks_in_the_middle():
    q, qd, qdd = Reference(SPECS["setpoint"], 2).sample(np.array([0.0, 0.5, 1.5, 2.5, 9.0]))
    assert q.tolist() == [[0.5, -1.0], [0.5, -1.0], [1.0, -0.5], [1.5, 0.0], [1.5, 0.0]]
    assert qd[:, 0].tolist() == pytest.approx([0, 0, 1.875 / 2, 0, 0])
    assert np.allclose(qdd[[0, 1, 3, 4]], 0)


def test_waypoints_are_passed_in_time_and_at_rest_outside():
    spec = SPECS["waypoints"]
    q, qd, qdd = Reference(spec, 2).sample(np.array([0.0, *spec.times, 9.0]))
    assert np.allclose(q[1:-1], spec.points, atol=1e-12)
    assert np.allclose(q[[0, -1]], [spec.points[0], spec.points[-1]])
    assert np.allclose(qd[[0, 1, -2, -1]], 0, atol=1e-9)
    assert np.allclose(qdd[[0, 1, -2, -1]], 0, atol=1e-8)
