"""The paper's controller with the network off: what feedback and inversion do alone.

    f̂ = [q̇; 0]        (or all zero with `kinematics: false`)

With B = [0; M⁻¹] of the true inertia this is a PD of gains K + λ and λK behind the inversion. The
observer runs along, so that its error shows what a network would have had to learn.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dnnmso_mj.controllers import Command
from dnnmso_mj.inversion import DynamicInversion
from dnnmso_mj.observer import StateObserver
from dnnmso_mj.plant import NominalModel
from dnnmso_mj.scenario import NoNetwork

Array = np.ndarray


class NoNetworkController:
    """Dynamic inversion without a learned model.

    Args:
        spec: gains of the scenario.
        n_joints: n.
        dt: control period (s).
        nominal: the controller's own model of the robot, read for B alone.
    """

    n_layers = 0

    def __init__(self, spec: NoNetwork, n_joints: int, dt: float, nominal: NominalModel) -> None:
        n = n_joints
        self._n = n
        self._kinematics = spec.kinematics
        self.inversion = DynamicInversion(spec.inversion, n, nominal)
        self.observer = StateObserver(spec.observer, 2 * n, dt)
        self._f_hat = np.zeros(2 * n)
        self._command = Command.of(self.inversion, self.observer, self._f_hat)

    def reset(self, x: Array) -> None:
        self.observer.reset(x)

    def update(self, x: Array, x_ref: Array, xd_ref: Array) -> Command:
        self.observer.compare(x)
        self._command.x_hat[:] = self.observer.x_hat
        if self._kinematics:
            self._f_hat[: self._n] = x[self._n :]
        self.inversion.command(x, x_ref, xd_ref, self._f_hat)
        self.observer.advance(self._f_hat, self.inversion.Bu)
        return self._command

    def effect(self, tau: Array) -> Array:
        return self.inversion.effect(tau)

    def state(self) -> dict[str, Array]:
        return {"x_hat": self.observer.x_hat.copy()}

    def restore(self, state: Mapping[str, Array]) -> None:
        self.observer.reset(state["x_hat"])
