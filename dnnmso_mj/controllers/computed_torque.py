"""Computed torque: inverse dynamics of the controller's own model.

    τ = M̂(q) (q̈_ref − K_d ė − K_p e) + V̂(q, q̇) + Ĝ(q)          e = q − q_ref

With the true model ë + K_d ė + K_p e = 0. With a wrong one it is a rival that may lose: at rest
K_p e = M̂(q)⁻¹ (Ĝ(q) − G(q)).

Luh, Walker and Paul, "Resolved-acceleration control of mechanical manipulators", IEEE Trans.
Automatic Control 25(3), 1980.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import inner
from dnnmso_mj.controllers import Command, CompiledTicks, Inputs
from dnnmso_mj.controllers.measured import empty_command, show_measured
from dnnmso_mj.inversion import solve_spd
from dnnmso_mj.plant import Nominal, NominalModel, bias, inertia
from dnnmso_mj.scenario import ComputedTorque, expand
from dnnmso_mj.tick import closed_loop

Array = np.ndarray


class Parts(NamedTuple):
    """The controller's arrays."""

    kp: Array  # (n,) 1/s²
    kd: Array  # (n,) 1/s
    fall: Array  # (n,) M̂⁻¹(V̂ + Ĝ), rad/s²
    wanted: Array  # (n,) rad/s²
    L: Array  # (n, n) scratch
    nominal: Nominal
    command: Command


class ComputedTorqueController:
    """Computed torque with a nominal model.

    Args:
        spec: gains of the scenario.
        n_joints: n.
        nominal: the controller's own model of the robot.
    """

    n_layers = 0

    def __init__(self, spec: ComputedTorque, n_joints: int, nominal: NominalModel) -> None:
        n = n_joints
        self._nominal = nominal  # keeps alive what compiled code knows by address
        self._parts = Parts(
            kp=expand(spec.kp, n),
            kd=expand(spec.kd, n),
            fall=np.zeros(n),
            wanted=np.zeros(n),
            L=np.zeros((n, n)),
            nominal=nominal.view,
            command=empty_command(n),
        )
        self.ticks = CompiledTicks(run_ticks, self._parts, ComputedTorqueController.update)

    def reset(self, x: Array) -> None:
        """The law has no memory."""

    def update(self, inputs: Inputs) -> Command:
        update(self._parts, inputs)
        return self._parts.command

    def dynamics(self, x: Array) -> Array:
        n = x.size // 2
        bias = self._nominal.bias(x[:n], x[n:]).copy()
        drift: Array = -np.linalg.solve(self._nominal.inertia(x[:n]), bias)
        return drift

    def state(self) -> dict[str, Array]:
        return {}

    def restore(self, state: Mapping[str, Array]) -> None:
        """The law has no memory."""


@inner
def update(parts: Parts, inputs: Inputs) -> None:
    """One tick of the law above."""
    x, x_ref, n = inputs.x, inputs.x_ref, parts.kp.size
    nominal, command = parts.nominal, parts.command
    inertia(nominal, x[:n])
    bias(nominal, x[:n], x[n:])
    solve_spd(nominal.M, nominal.bias, parts.fall, parts.L)
    show_measured(command, x)
    for i in range(n):
        command.f_hat[n + i] = -parts.fall[i]
        e, ed = x[i] - x_ref[i], x[n + i] - x_ref[n + i]
        parts.wanted[i] = inputs.xd_ref[n + i] - parts.kd[i] * ed - parts.kp[i] * e
    for i in range(n):
        command.tau[i] = nominal.bias[i]
        for j in range(n):
            command.tau[i] += nominal.M[i, j] * parts.wanted[j]


run_ticks = closed_loop(update)
