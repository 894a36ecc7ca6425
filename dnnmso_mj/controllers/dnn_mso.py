"""The paper's controller: a deep network learns all the dynamics while inversion uses it.

    X̂̇ = f̂(X) + B u + K₂ e_a          (Eq. 5, with the stable sign)
    u  = B̄⁻¹ (f* − f̂(X) − K e_r)      (Eq. 10 and slack augmentation)
    W  ← Madam(W, ∂½‖e_a‖²/∂W)         (Alg. 1), where ∂loss/∂f̂ ∝ −e_a

Each tick commands with the weights it has, and then learns from the observer's error.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dnnmso_mj.controllers import Command
from dnnmso_mj.inversion import DynamicInversion
from dnnmso_mj.learner import build_learner
from dnnmso_mj.observer import StateObserver
from dnnmso_mj.plant import NominalModel
from dnnmso_mj.scenario import DnnMso

Array = np.ndarray


class DnnMsoController:
    """DNN-MSO with dynamic inversion.

    Args:
        spec: gains, network and Madam of the scenario.
        n_joints: n.
        dt: control period (s).
        seed: of the initial weights.
        nominal: the controller's own model of the robot, read for B alone.
    """

    def __init__(
        self, spec: DnnMso, n_joints: int, dt: float, seed: int, nominal: NominalModel
    ) -> None:
        n = n_joints
        # outputs: kinematic leaves the upper rows to the measured velocity.
        self._first = n if spec.network.outputs == "kinematic" else 0
        self._n = n
        self.inversion = DynamicInversion(spec.inversion, n, nominal)
        self.observer = StateObserver(spec.observer, 2 * n, dt)
        self.learner = build_learner(spec.network, spec.madam, 2 * n, 2 * n - self._first, seed)
        self.n_layers = self.learner.shape.n_layers
        self._f_hat = np.zeros(2 * n)
        self._delta = np.zeros(2 * n - self._first)
        self._command = Command.of(self.inversion, self.observer, self._f_hat)
        self._command.monitors = self.learner.monitors

    def reset(self, x: Array) -> None:
        self.observer.reset(x)

    def update(self, x: Array, x_ref: Array, xd_ref: Array) -> Command:
        e_obs = self.observer.compare(x)
        self._command.x_hat[:] = self.observer.x_hat
        self._f_hat[: self._first] = x[self._n :][: self._first]
        self._f_hat[self._first :] = self.learner.predict(x)
        self.inversion.command(x, x_ref, xd_ref, self._f_hat)
        self.learner.learn(np.negative(e_obs[self._first :], out=self._delta))
        self.observer.advance(self._f_hat, self.inversion.Bu)
        return self._command

    def effect(self, tau: Array) -> Array:
        return self.inversion.effect(tau)

    def state(self) -> dict[str, Array]:
        return {"x_hat": self.observer.x_hat.copy(), **self.learner.state()}

    def restore(self, state: Mapping[str, Array]) -> None:
        self.observer.reset(state["x_hat"])
        self.learner.restore(state)
