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

import numpy as np

from dnnmso_mj.plant import NominalModel
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


class DynamicInversion:
    """The inversion law at the control period.

    Args:
        spec: K (1/s), the slack matrix and what the controller takes for B.
        n_joints: n.
        nominal: the controller's own model, needed when B₂ = M(q)⁻¹.

    Attributes:
        tau: u (n,) N·m, the last command.
        Bu: B u (2n,), its effect as the controller sees it.
    """

    def __init__(self, spec: InversionSpec, n_joints: int, nominal: NominalModel) -> None:
        n = n_joints
        self._n = n
        self._K = expand(spec.K, 2 * n)
        self._coupling = slack_coupling(slack_matrix(spec, n))
        self._nominal = nominal
        effectiveness = spec.effectiveness
        self._constant = isinstance(effectiveness, Constant)
        b = effectiveness.b if isinstance(effectiveness, Constant) else 1.0
        self._B2_inv: Array = np.eye(n) / b
        self._r = np.zeros(2 * n)
        self._scratch = np.zeros(2 * n)
        self.tau = np.zeros(n)
        self.Bu = np.zeros(2 * n)

    def command(self, x: Array, x_ref: Array, xd_ref: Array, f_hat: Array) -> Array:
        """u = B₂⁻¹ (r₂ + Λ r₁) for state x, reference x_ref, its derivative, and f̂, each (2n,)."""
        n, r = self._n, self._r
        e_track = np.subtract(x, x_ref, out=self._scratch)
        np.multiply(self._K, e_track, out=r)
        np.subtract(xd_ref, r, out=r)
        r -= f_hat
        acceleration = self.Bu[n:]
        np.dot(self._coupling, r[:n], out=acceleration)
        acceleration += r[n:]
        if not self._constant:
            self._B2_inv[:] = self._nominal.inertia(x[:n])
        return np.dot(self._B2_inv, acceleration, out=self.tau)

    def effect(self, tau: Array) -> Array:
        """B τ (2n,) of another torque, e.g. a saturated one, at the state of the last command."""
        Bu = np.zeros(2 * self._n)
        Bu[self._n :] = np.linalg.solve(self._B2_inv, tau)
        return Bu
