"""Dry friction that really holds a joint: Coulomb, Stribeck and stiction, without smoothing.

    |τ_f,i| ≤ F_i = coulomb + (breakaway − coulomb) exp(−(q̇_i/stribeck_velocity)²)

and τ_f opposes the motion with all of F, or stops the joint with less. Which of both is decided for
the velocity at the end of the period, as in time-stepping schemes for rigid bodies with friction
(Moreau; Stewart and Trinkle, 1996): with v = q̇ + dt (q̈_free + M⁻¹ τ_f),

    v_i > 0 ⇒ τ_f,i = −F_i,    v_i < 0 ⇒ τ_f,i = F_i,    |τ_f,i| < F_i ⇒ v_i = 0.

M is positive definite, so τ_f is unique, and projected Gauss-Seidel finds it. The friction of a
period takes power τ_fᵀ v ≤ 0 and can stop a joint but never reverse it: no chatter, no creep.
A smoothed sign, as tanh(q̇/v₀), creeps at rest and chatters once dt·F/(v₀ M) passes 2.

The torque is held through the step, as the motors' is. Runge-Kutta then ends at v but for terms of
dt², which the next period's friction takes off again. Viscous friction is MuJoCo's own damping.
"""

from __future__ import annotations

import math

import numpy as np

from dnnmso_mj.compiling import compiled
from dnnmso_mj.mujoco_calls import mj_solveM
from dnnmso_mj.scenario import Friction, expand

Array = np.ndarray

# Rows of the law.
COULOMB, EXTRA, STRIBECK = range(3)

SWEEPS = 200  # two-link: 5 to 20 do
CLOSE = 1e-13  # of F


def friction_law(spec: Friction, n_joints: int) -> Array:
    """(3, n): coulomb, breakaway − coulomb (N·m) and the Stribeck velocity (rad/s)."""
    coulomb = expand(spec.coulomb, n_joints)
    holds = coulomb if spec.breakaway is None else expand(spec.breakaway, n_joints)
    return np.array([coulomb, holds - coulomb, expand(spec.stribeck_velocity, n_joints)])


@compiled
def rub(
    model: int, data: int, dt: float, qd: Array, qdd: Array, law: Array, scratch: Array, tau: Array
) -> None:
    """Friction torque (n,) N·m of the next period into `tau`, which holds that of the last one.

    Args:
        model, data: of the plant, by address, after `mj_forward` without friction.
        dt: period (s).
        qd: q̇ (n,) rad/s.
        qdd: q̈ (n,) rad/s² without friction.
        law: see `friction_law`.
        scratch: (2 or more, n or more, n), the identity first.
        tau: in and out.
    """
    n = qd.size
    inverse = scratch[1]
    mj_solveM(model, data, inverse.ctypes.data, scratch.ctypes.data, n)
    for _ in range(SWEEPS):
        furthest = 0.0
        for i in range(n):
            most = law[COULOMB, i] + law[EXTRA, i] * math.exp(-((qd[i] / law[STRIBECK, i]) ** 2))
            v = qd[i] + dt * qdd[i]
            for j in range(n):
                v += dt * inverse[i, j] * tau[j]
            stopping = tau[i] - v / (dt * inverse[i, i])
            held = min(max(stopping, -most), most)
            furthest = max(furthest, abs(held - tau[i]) - CLOSE * most)
            tau[i] = held
        if furthest <= 0.0:
            break
