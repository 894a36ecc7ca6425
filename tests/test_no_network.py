"""The controller without a network: what f̂ it takes, and the torque that follows."""

from __future__ import annotations

import numpy as np
import pytest

from dnnmso_mj.dynamics import TwoLink
from dnnmso_mj.simulation import simulate


@pytest.mark.parametrize("kinematics", [True, False])
def test_f_hat_is_the_velocity_or_nothing_and_the_torque_follows(make_scenario, kinematics):
    """τ = M (r₂ + λ r₁) with r = f* − f̂ − K e, gravity and Coriolis unknown."""
    controller = {"kind": "no_network", "kinematics": kinematics}
    trace = simulate(
        make_scenario(controller, initial={"q": [0.2, 0.4], "qd": [0.3, -0.6]}, duration=0.1)
    )
    q, qd = trace["q"], trace["qd"]
    known = qd if kinematics else np.zeros_like(qd)
    assert np.array_equal(trace["f_hat"], np.hstack([known, np.zeros_like(qd)]))
    K = lam = 7.5
    t = trace["t"]
    qdd_ref = -0.25 * np.stack([np.sin(0.5 * t), np.sin(0.5 * t + np.pi / 2)], axis=1)
    upper = trace["qd_ref"] - known - K * (q - trace["q_ref"])
    lower = qdd_ref - K * (qd - trace["qd_ref"])
    M = TwoLink((1.0, 2.3), (1.0, 1.0)).inertia(q)
    expected = np.einsum("kij,kj->ki", M, lower + lam * upper)
    assert np.allclose(trace["tau_cmd"], expected, rtol=1e-9, atol=1e-9)
