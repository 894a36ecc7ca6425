"""Control effectiveness: what a controller takes torque to do, q̈ = f₂(x) + B₂(q) τ.

B₂ = M(q)⁻¹ of the controller's nominal model, or b·I without one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import copy, inner
from dnnmso_mj.inversion import solve_spd
from dnnmso_mj.plant import Nominal, inertia
from dnnmso_mj.scenario import Constant
from dnnmso_mj.scenario import Effectiveness as EffectivenessSpec

Array = np.ndarray


class Effectiveness(NamedTuple):
    """B₂ at the angles of the last `evaluate`."""

    B2_inv: Array  # (n, n) kg·m²
    L: Array  # (n, n) scratch
    nominal: Nominal
    constant: bool  # B₂ = b·I


def build_effectiveness(spec: EffectivenessSpec, n: int, nominal: Nominal) -> Effectiveness:
    """The effectiveness of a scenario for n joints, with the controller's own model."""
    constant = isinstance(spec, Constant)
    b = spec.b if isinstance(spec, Constant) else 1.0
    return Effectiveness(np.eye(n) / b, np.zeros((n, n)), nominal, constant)


@inner
def evaluate(effectiveness: Effectiveness, q: Array) -> None:
    """Take B₂ at q (n,) rad."""
    if not effectiveness.constant:
        inertia(effectiveness.nominal, q)
        for i in range(q.size):
            copy(effectiveness.nominal.M[i], effectiveness.B2_inv[i])


@inner
def torque_for(effectiveness: Effectiveness, acceleration: Array, tau: Array) -> None:
    """τ = B₂⁻¹ a (n,) N·m for a (n,) rad/s²."""
    for i in range(tau.size):
        tau[i] = 0.0
        for j in range(tau.size):
            tau[i] += effectiveness.B2_inv[i, j] * acceleration[j]


@inner
def acceleration_of(effectiveness: Effectiveness, tau: Array, acceleration: Array) -> None:
    """a = B₂ τ (n,) rad/s² for τ (n,) N·m."""
    solve_spd(effectiveness.B2_inv, tau, acceleration, effectiveness.L)
