"""Dynamic inversion with slack augmentation: from the desired Ẋ to torque.

    B u = r,   r = f* − f̂ − K e_r          (Eq. 10)

B = [0; B₂] is 2n×n, so the paper augments it, B̄ = [B B_s], and inverts

    [u; u_s'] = B̄⁻¹ (r + B_s u_s).

With B_s = [S₁; S₂], S₁ invertible, the upper rows give u_s' − u_s = S₁⁻¹ r₁, the lower ones

    u = B₂⁻¹ (r₂ + Λ r₁),   Λ = −S₂ S₁⁻¹.

So u does not depend on u_s, and of B_s only Λ matters; B_s = [I; −λI] gives Λ = λI. The controller
uses this closed form; `invert_augmented` is the general inverse it is tested against.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import compiled, copy, inner
from dnnmso_mj.plant import Nominal, inertia
from dnnmso_mj.scenario import Constant, expand
from dnnmso_mj.scenario import Inversion as InversionSpec

Array = np.ndarray


def slack_matrix(spec: InversionSpec, n: int) -> Array:
    """B_s (2n, n): the scenario's own, or [I; −λI]."""
    if spec.slack_matrix is not None:
        return np.array(spec.slack_matrix)
    identity = np.eye(n)
    return np.vstack([identity, -spec.lam * identity])


def slack_coupling(B_s: Array) -> Array:
    """Λ = −S₂ S₁⁻¹ (n, n) of B_s = [S₁; S₂] (2n, n)."""
    n = B_s.shape[1]
    coupling: Array = -np.linalg.solve(B_s[:n].T, B_s[n:].T).T
    return coupling


def invert_augmented(B: Array, B_s: Array, r: Array, u_s: Array) -> tuple[Array, Array]:
    """[u; u_s'] = [B B_s]⁻¹ (r + B_s u_s), for any B (2n, n) that B_s completes to full rank.

    Returns:
        u (n,) and u_s' (n,).

    Raises:
        numpy.linalg.LinAlgError: [B B_s] is singular.
    """
    n = B.shape[1]
    U = np.linalg.solve(np.hstack([B, B_s]), r + B_s @ u_s)
    return U[:n], U[n:]


class DynamicInversion(NamedTuple):
    """The inversion law at the control period, and its last command."""

    tau: Array  # u (n,) N·m
    Bu: Array  # B u (2n,), its effect as the controller sees it
    B2_inv: Array  # (n, n) of the last command
    K: Array  # (2n,) 1/s
    coupling: Array  # Λ (n, n)
    r: Array  # (2n,)
    nominal: Nominal  # the controller's own model, read where B₂ = M(q)⁻¹
    constant: bool  # B₂ = b·I


def build_inversion(spec: InversionSpec, n_joints: int, nominal: Nominal) -> DynamicInversion:
    """The inversion of a scenario for n joints, with the controller's own model."""
    n = n_joints
    effectiveness = spec.effectiveness
    b = effectiveness.b if isinstance(effectiveness, Constant) else 1.0
    return DynamicInversion(
        tau=np.zeros(n),
        Bu=np.zeros(2 * n),
        B2_inv=np.eye(n) / b,
        K=expand(spec.K, 2 * n),
        coupling=np.ascontiguousarray(slack_coupling(slack_matrix(spec, n))),
        r=np.zeros(2 * n),
        nominal=nominal,
        constant=isinstance(effectiveness, Constant),
    )


@inner
def invert(
    inversion: DynamicInversion, x: Array, x_ref: Array, xd_ref: Array, f_hat: Array
) -> None:
    """u = B₂⁻¹ (r₂ + Λ r₁) for state x, reference x_ref, its derivative, and f̂, each (2n,)."""
    n, r = inversion.tau.size, inversion.r
    for i in range(2 * n):
        r[i] = xd_ref[i] - f_hat[i] - inversion.K[i] * (x[i] - x_ref[i])
    acceleration = inversion.Bu[n:]
    for i in range(n):
        acceleration[i] = r[n + i]
        for j in range(n):
            acceleration[i] += inversion.coupling[i, j] * r[j]
    if not inversion.constant:
        inertia(inversion.nominal, x[:n])
        for i in range(n):
            copy(inversion.nominal.M[i], inversion.B2_inv[i])
    for i in range(n):
        inversion.tau[i] = 0.0
        for j in range(n):
            inversion.tau[i] += inversion.B2_inv[i, j] * acceleration[j]


@compiled
def solve_spd(A: Array, b: Array, x: Array, L: Array) -> None:
    """x = A⁻¹ b for symmetric positive definite A (n, n), by Cholesky; L (n, n) is scratch."""
    n = b.size
    for i in range(n):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(total) if i == j else total / L[j, j]
    for i in range(n):
        total = b[i]
        for k in range(i):
            total -= L[i, k] * x[k]
        x[i] = total / L[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= L[k, i] * x[k]
        x[i] = total / L[i, i]
