"""Analytic dynamics of planar serial arms, M(q) q̈ + V(q, q̇) + G(q) = τ, in NumPy alone.

The two-link closed forms are the oracle that MuJoCo is held against. q₁ is measured from the
horizontal, q₂ from link 1; gravity acts downwards in the plane. With link i's mass m_i, length l_i,
distance of the centre of mass c_i and inertia I_i about that centre:

    α = m₁c₁² + I₁ + m₂l₁²     β = m₂c₂² + I₂     h = m₂ l₁ c₂

    M = [[α + β + 2h cos q₂,  β + h cos q₂],  [β + h cos q₂,  β]]
    V = h sin q₂ · [−(2 q̇₁q̇₂ + q̇₂²),  q̇₁²]
    G = g · [(m₁c₁ + m₂l₁) cos q₁ + m₂c₂ cos(q₁+q₂),  m₂c₂ cos(q₁+q₂)]

A point mass at the tip has c = l, I = 0; a uniform thin rod c = l/2, I = m l²/12.
Source: Lewis, Dawson, Abdallah, "Robot Manipulator Control", ch. 3; the paper's simulation section.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

Array = np.ndarray
Links = Literal["point_mass", "rod"]
LINKS: tuple[Links, ...] = ("point_mass", "rod")


@dataclass(frozen=True)
class TwoLink:
    """A two-link planar arm.

    Args:
        masses: m₁, m₂ (kg).
        lengths: l₁, l₂ (m).
        gravity: g (m/s²).
        links: "point_mass" at each tip, or uniform thin "rod".
    """

    masses: tuple[float, float]
    lengths: tuple[float, float]
    gravity: float = 9.81
    links: Links = "point_mass"

    @property
    def _lumped(self) -> tuple[float, float, float, float, float]:
        """α, β, h and the two gravity moments per unit g."""
        (m1, m2), (l1, l2) = self.masses, self.lengths
        (c1, i1), (c2, i2) = (
            centre_and_inertia(self.links, m1, l1),
            centre_and_inertia(self.links, m2, l2),
        )
        alpha = m1 * c1**2 + i1 + m2 * l1**2
        beta = m2 * c2**2 + i2
        return alpha, beta, m2 * l1 * c2, m1 * c1 + m2 * l1, m2 * c2

    def inertia(self, q: Array) -> Array:
        """M(q), kg·m². q: (..., 2) rad. Returns (..., 2, 2)."""
        alpha, beta, h, _, _ = self._lumped
        coupling = h * np.cos(q[..., 1])
        M = np.empty((*q.shape[:-1], 2, 2))
        M[..., 0, 0] = alpha + beta + 2 * coupling
        M[..., 0, 1] = M[..., 1, 0] = beta + coupling
        M[..., 1, 1] = beta
        return M

    def coriolis_matrix(self, q: Array, qd: Array) -> Array:
        """V_m(q, q̇) from Christoffel symbols, for which Ṁ − 2 V_m is skew. Returns (..., 2, 2)."""
        _, _, h, _, _ = self._lumped
        s = h * np.sin(q[..., 1])
        V_m = np.zeros((*q.shape[:-1], 2, 2))
        V_m[..., 0, 0] = -s * qd[..., 1]
        V_m[..., 0, 1] = -s * (qd[..., 0] + qd[..., 1])
        V_m[..., 1, 0] = s * qd[..., 0]
        return V_m

    def coriolis(self, q: Array, qd: Array) -> Array:
        """V = V_m(q, q̇) q̇, N·m. Returns (..., 2)."""
        _, _, h, _, _ = self._lumped
        s = h * np.sin(q[..., 1])
        qd1, qd2 = qd[..., 0], qd[..., 1]
        return np.stack([-s * (2 * qd1 * qd2 + qd2**2), s * qd1**2], axis=-1)

    def gravity_torque(self, q: Array) -> Array:
        """G(q), N·m. Returns (..., 2)."""
        _, _, _, first, second = self._lumped
        outer = self.gravity * second * np.cos(q[..., 0] + q[..., 1])
        return np.stack([self.gravity * first * np.cos(q[..., 0]) + outer, outer], axis=-1)

    def acceleration(self, q: Array, qd: Array, tau: Array) -> Array:
        """q̈ = M⁻¹(τ − V − G), rad/s². Returns (..., 2)."""
        force = tau - self.coriolis(q, qd) - self.gravity_torque(q)
        return np.linalg.solve(self.inertia(q), force[..., None])[..., 0]

    def energy(self, q: Array, qd: Array) -> Array:
        """½ q̇ᵀ M q̇ + potential energy, J, zero at rest along the horizontal. Returns (...)."""
        _, _, _, first, second = self._lumped
        kinetic = 0.5 * np.einsum("...i,...ij,...j", qd, self.inertia(q), qd)
        heights = first * np.sin(q[..., 0]) + second * np.sin(q[..., 0] + q[..., 1])
        energy: Array = kinetic + self.gravity * heights
        return energy


def centre_and_inertia(links: Links, mass: float, length: float) -> tuple[float, float]:
    """Distance of a link's centre of mass from its joint (m) and its inertia about it (kg·m²)."""
    return (length, 0.0) if links == "point_mass" else (length / 2, mass * length**2 / 12)
