"""The two-link arm in a vertical plane, linear in what is unknown of it.

    M(q) a + C(q, q̇) v + G(q) + F v = Y(q, q̇, v, a) θ,    θ = (p₁, p₂, p₃, g₁, g₂, f₁, f₂)

    M = [[p₁ + 2p₂ cos q₂,  p₃ + p₂ cos q₂],  [p₃ + p₂ cos q₂,  p₃]]
    C = p₂ sin q₂ · [[−q̇₂,  −(q̇₁+q̇₂)],  [q̇₁,  0]]          Ṁ − 2C is skew
    G = [g₁ cos q₁ + g₂ cos(q₁+q₂),  g₂ cos(q₁+q₂)]            F = diag(f₁, f₂)

Any masses, centres of mass along the links, inertias and load at the tip are such an arm.

Since Ṁ = C + Cᵀ, the motion M q̈ + C q̇ + G + F q̇ = τ is also

    d/dt (M q̇) − Cᵀ q̇ + G + F q̇ = τ,

which asks for no acceleration: its integral over time is what is learned from.

Source: Slotine, Li, "On the adaptive control of robot manipulators", Int. J. Robotics Research
6(3), 1987; Lewis, Dawson, Abdallah, "Robot Manipulator Control", ch. 3 and 6.
"""

from __future__ import annotations

import math

import numpy as np

from dnnmso_mj.compiling import compiled
from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.plant import NominalModel
from dnnmso_mj.scenario.adaptive import N_PARAMETERS

Array = np.ndarray

# Below this ratio of det M̂ to (tr M̂)² an estimate is no inertia that could be inverted.
SINGULAR_BELOW = 1e-6

MISFIT = 1e-9


@compiled
def regressor(x: Array, v: Array, a: Array, Y: Array) -> None:
    """Y(q, q̇, v, a) (2, 7) at x = [q; q̇] (4,), for v (2,) rad/s and a (2,) rad/s²."""
    s2, c2 = math.sin(x[1]), math.cos(x[1])
    c12 = math.cos(x[0] + x[1])
    Y[:] = 0.0
    Y[0, 0] = a[0]
    Y[0, 1] = c2 * (2.0 * a[0] + a[1]) - s2 * (x[3] * v[0] + (x[2] + x[3]) * v[1])
    Y[0, 2] = a[1]
    Y[0, 3] = math.cos(x[0])
    Y[0, 4] = Y[1, 4] = c12
    Y[0, 5] = v[0]
    Y[1, 1] = c2 * a[0] + s2 * x[2] * v[0]
    Y[1, 2] = a[0] + a[1]
    Y[1, 6] = v[1]


@compiled
def momentum(x: Array, Y: Array) -> None:
    """Y (2, 7) of the generalized momentum M q̇ = Y θ, N·m·s, at x (4,)."""
    c2 = math.cos(x[1])
    Y[:] = 0.0
    Y[0, 0] = x[2]
    Y[0, 1] = c2 * (2.0 * x[2] + x[3])
    Y[0, 2] = x[3]
    Y[1, 1] = c2 * x[2]
    Y[1, 2] = x[2] + x[3]


@compiled
def momentum_loss(x: Array, Y: Array) -> None:
    """Y (2, 7) of −Cᵀ q̇ + G + F q̇ = τ − d/dt (M q̇) = Y θ, N·m, at x (4,)."""
    c12 = math.cos(x[0] + x[1])
    Y[:] = 0.0
    Y[0, 3] = math.cos(x[0])
    Y[0, 4] = Y[1, 4] = c12
    Y[0, 5] = x[2]
    Y[1, 1] = math.sin(x[1]) * x[2] * (x[2] + x[3])
    Y[1, 6] = x[3]


@compiled
def drift(theta: Array, x: Array, out: Array) -> None:
    """−M̂⁻¹ (C q̇ + G + F q̇) (2,) rad/s² of the estimates θ̂; zero while M̂ is no inertia matrix."""
    s2, c2 = theta[1] * math.sin(x[1]), theta[1] * math.cos(x[1])
    m11, m12, m22 = theta[0] + 2.0 * c2, theta[2] + c2, theta[2]
    g12 = theta[4] * math.cos(x[0] + x[1])
    b1 = -s2 * x[3] * (2.0 * x[2] + x[3]) + theta[3] * math.cos(x[0]) + g12 + theta[5] * x[2]
    b2 = s2 * x[2] * x[2] + g12 + theta[6] * x[3]
    det, trace = m11 * m22 - m12 * m12, m11 + m22
    if m22 > 0.0 and det > SINGULAR_BELOW * trace * trace:
        out[0] = (m12 * b2 - m22 * b1) / det
        out[1] = (m12 * b1 - m11 * b2) / det
    else:
        out[0] = out[1] = 0.0


def refuse_other_arms(nominal: NominalModel, kind: str) -> None:
    """Refuse a robot whose M, V and G are those of no two-link arm in a vertical plane.

    Args:
        nominal: the model that the controller may ask for its form; its numbers stay unknown.
        kind: of the controller, for the message.

    Raises:
        ScenarioError: the robot is of another form.
    """
    n = nominal.view.M.shape[0]
    if n != 2 or not _fits(nominal):
        what = f"a robot of {n} joint{'s' * (n != 1)}" if n != 2 else "this arm"
        raise ScenarioError(
            f"controller.kind = {kind}: its regressor does not fit {what}; allowed: "
            "two hinges about parallel axes, q1 from the horizontal and q2 from link 1, centres of "
            "mass along the links. For other robots take a controller without a regressor, such as "
            "dnn_mso"
        )


def _fits(nominal: NominalModel) -> bool:
    """Whether some θ explains M and V + G at random states."""
    rng = np.random.default_rng(0)
    rows, torques = [], []
    for _ in range(20):
        q, qd, qdd = rng.uniform(-3.0, 3.0, size=(3, 2))
        Y = np.zeros((2, N_PARAMETERS))
        regressor(np.concatenate([q, qd]), qd, qdd, Y)
        rows.append(Y)
        torques.append(nominal.inertia(q) @ qdd + nominal.bias(q, qd))
    Y, tau = np.concatenate(rows), np.concatenate(torques)
    theta = np.linalg.lstsq(Y, tau, rcond=None)[0]
    return float(np.abs(Y @ theta - tau).max()) <= MISFIT * float(np.abs(tau).max())
