"""The classical modified state observer: known dynamics plus a learned uncertainty (Eq. 4).

    X̂̇ = f(X̂) + B (u + d̂(X)) + K₂ e_a
    u  = B̄⁻¹ (f* − f(X) − B d̂(X) − K e_r)

f and B come from the nominal model, which a scenario may set wrong; d̂ (n,) N·m is learned from
∂½‖e_a‖²/∂d̂ ∝ −Bᵀ e_a.

N.B. the paper prints Eq. 4 with an unbalanced parenthesis, which leaves it open whether B
multiplies K₂, and with the unstable sign; K₂ stands alone here, as in the DNN-MSO. The works it
cites train d̂ by gradient laws of their own; here Madam trains it, so that only the model differs.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dnnmso_mj.controllers import Command
from dnnmso_mj.inversion import DynamicInversion
from dnnmso_mj.learner import build_learner
from dnnmso_mj.observer import StateObserver
from dnnmso_mj.plant import NominalModel
from dnnmso_mj.scenario import ClassicalMso

Array = np.ndarray


class ClassicalMsoController:
    """MSO with known dynamics and a learned matched uncertainty.

    Args:
        spec: gains, network and Madam of the scenario.
        n_joints: n.
        dt: control period (s).
        seed: of the initial weights.
        nominal: the controller's own model of the robot, read for f and B.
    """

    def __init__(
        self, spec: ClassicalMso, n_joints: int, dt: float, seed: int, nominal: NominalModel
    ) -> None:
        n = n_joints
        self._n, self._nominal = n, nominal
        self.inversion = DynamicInversion(spec.inversion, n, nominal)
        self.observer = StateObserver(spec.observer, 2 * n, dt)
        self.learner = build_learner(spec.network, spec.madam, 2 * n, n, seed)
        self.n_layers = self.learner.shape.n_layers
        self._f_hat, self._f_obs = np.zeros(2 * n), np.zeros(2 * n)
        self._command = Command.of(self.inversion, self.observer, self._f_hat)
        self._command.monitors = self.learner.monitors

    def reset(self, x: Array) -> None:
        self.observer.reset(x)

    def update(self, x: Array, x_ref: Array, xd_ref: Array) -> Command:
        n = self._n
        e_obs = self.observer.compare(x)
        self._command.x_hat[:] = self.observer.x_hat
        d_hat = self.learner.predict(x)
        self._known(x, self._f_hat)
        B2_inv = self._nominal.inertia(x[:n])
        learned = np.linalg.solve(B2_inv, d_hat)  # B₂ d̂ (n,)
        self._f_hat[n:] += learned
        self.inversion.command(x, x_ref, xd_ref, self._f_hat)
        self.learner.learn(-np.linalg.solve(B2_inv, e_obs[n:]))  # B₂ is symmetric
        self._known(self.observer.x_hat, self._f_obs)
        self._f_obs[n:] += learned
        self.observer.advance(self._f_obs, self.inversion.Bu)
        return self._command

    def _known(self, x: Array, out: Array) -> None:
        """f(x) = [q̇; −M⁻¹(V + G)] (2n,) of the nominal model."""
        n = self._n
        bias = self._nominal.bias(x[:n], x[n:])
        out[:n] = x[n:]
        out[n:] = np.linalg.solve(self._nominal.inertia(x[:n]), -bias)

    def effect(self, tau: Array) -> Array:
        return self.inversion.effect(tau)

    def state(self) -> dict[str, Array]:
        return {"x_hat": self.observer.x_hat.copy(), **self.learner.state()}

    def restore(self, state: Mapping[str, Array]) -> None:
        self.observer.reset(state["x_hat"])
        self.learner.restore(state)
