"""Dry friction that really holds a joint: Coulomb, Stribeck and stiction, without smoothing.

    |τ_f,i| ≤ F_i = coulomb + (breakaway − coulomb) exp(−(q̇_i/stribeck_velocity)²)

and τ_f opposes the motion with all of F, or stops the joint with less. Which of both is decided for
the velocity at the end of the period, as in time-stepping schemes for rigid bodies with friction
(Moreau; Stewart and Trinkle, 1996): with v = q̇ + dt (q̈_free + M⁻¹ τ_f),

    v_i > 0 ⇒ τ_f,i = −F_i,    v_i < 0 ⇒ τ_f,i = F_i,    |τ_f,i| < F_i ⇒ v_i = 0.

M is positive definite, so τ_f is unique. Projected Gauss-Seidel finds which joints are held, and a
linear system then what holds them. The friction of a period takes power τ_fᵀ v ≤ 0 and can stop a
joint but never reverse it: no chatter, no creep. A smoothed sign, as tanh(q̇/v₀), creeps at rest and
chatters once dt·F/(v₀ M) passes 2.

The torque is held through the step, as the motors' is. Runge-Kutta then ends at v but for terms of
dt², which the next period's friction takes off again. Viscous friction is MuJoCo's own damping.
"""

from __future__ import annotations

import math

import numpy as np

from dnnmso_mj.compiling import compiled, copy, inner
from dnnmso_mj.inversion import solve_spd
from dnnmso_mj.mujoco_calls import mj_solveM
from dnnmso_mj.scenario import Friction, expand

Array = np.ndarray

# Rows of the law.
COULOMB, EXTRA, STRIBECK = range(3)

# Parts of the scratch memory; MASS_INV takes M⁻¹, HELD its rows and columns of held joints.
UNIT, MASS_INV, HELD, FACTOR, VECTORS = range(5)
N_PARTS = 5
V_FREE, SOLVED, RIGHT = range(3)  # rows of VECTORS

SWEEPS = 200  # few do


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
        scratch: (N_PARTS, at least 3 and n, n), the identity in UNIT.
        tau: in and out.
    """
    n, v_free = qd.size, scratch[VECTORS, V_FREE]
    mj_solveM(model, data, scratch[MASS_INV].ctypes.data, scratch[UNIT].ctypes.data, n)
    for i in range(n):
        v_free[i] = (qd[i] + dt * qdd[i]) / dt
    for _ in range(SWEEPS):
        for i in range(n):
            most = _most(law, i, qd[i])
            stopping = tau[i] - _velocity(scratch, tau, i) / scratch[MASS_INV, i, i]
            tau[i] = min(max(stopping, -most), most)
        if _hold(law, qd, scratch, tau):
            break


@inner
def _most(law: Array, i: int, qd: float) -> float:
    """F (N·m) of joint i at q̇ (rad/s)."""
    return law[COULOMB, i] + law[EXTRA, i] * math.exp(-((qd / law[STRIBECK, i]) ** 2))


@inner
def _velocity(scratch: Array, tau: Array, i: int) -> float:
    """v_i/dt (rad/s²) at the end of the period under friction τ (n,) N·m."""
    v = scratch[VECTORS, V_FREE, i]
    for j in range(tau.size):
        v += scratch[MASS_INV, i, j] * tau[j]
    return v


@compiled
def _hold(law: Array, qd: Array, scratch: Array, tau: Array) -> bool:
    """Stop at once all joints that τ (n,) holds with less than F; False if that is not the law."""
    n, solved, right = qd.size, scratch[VECTORS, SOLVED], scratch[VECTORS, RIGHT]
    for i in range(n):
        held = abs(tau[i]) < _most(law, i, qd[i])
        right[i] = -scratch[VECTORS, V_FREE, i] if held else tau[i]
        for j in range(n):
            other = abs(tau[j]) < _most(law, j, qd[j])
            if held and not other:
                right[i] -= scratch[MASS_INV, i, j] * tau[j]
            both = held and other
            scratch[HELD, i, j] = scratch[MASS_INV, i, j] if both else scratch[UNIT, i, j]
    solve_spd(scratch[HELD], right, solved, scratch[FACTOR])
    for i in range(n):
        if abs(tau[i]) < _most(law, i, qd[i]):
            if abs(solved[i]) > _most(law, i, qd[i]):
                return False
        elif tau[i] * _velocity(scratch, solved, i) > 0.0:
            return False
    copy(solved, tau)
    return True
