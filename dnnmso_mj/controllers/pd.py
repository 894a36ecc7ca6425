"""Proportional-derivative feedback at each joint, without any model.

    τ = −K_p e − K_d ė          e = q − q_ref

At rest K_p e = −G(q): gravity leaves an error of G/K_p. For a regulator of a robot without gravity
the law is globally stable with any positive gains: Takegaki and Arimoto, "A new feedback method for
dynamic control of manipulators", ASME J. Dyn. Syst. Meas. Control 103, 1981.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import inner
from dnnmso_mj.controllers import Command, CompiledTicks, Inputs
from dnnmso_mj.controllers.measured import empty_command, show_measured
from dnnmso_mj.scenario import Pd, expand
from dnnmso_mj.tick import closed_loop

Array = np.ndarray


class Parts(NamedTuple):
    """The controller's arrays."""

    kp: Array  # (n,) N·m/rad
    kd: Array  # (n,) N·m·s/rad
    command: Command


class PdController:
    """PD of the joint error.

    Args:
        spec: gains of the scenario.
        n_joints: n.
    """

    n_layers = 0

    def __init__(self, spec: Pd, n_joints: int) -> None:
        n = n_joints
        self._parts = Parts(expand(spec.kp, n), expand(spec.kd, n), empty_command(n))
        self.ticks = CompiledTicks(run_ticks, self._parts, PdController.update)

    def reset(self, x: Array) -> None:
        """The law has no memory."""

    def update(self, inputs: Inputs) -> Command:
        update(self._parts, inputs)
        return self._parts.command

    def dynamics(self, x: Array) -> Array:
        return np.zeros(x.size // 2)

    def state(self) -> dict[str, Array]:
        return {}

    def restore(self, state: Mapping[str, Array]) -> None:
        """The law has no memory."""


@inner
def update(parts: Parts, inputs: Inputs) -> None:
    """One tick of the law above."""
    x, x_ref, n = inputs.x, inputs.x_ref, parts.kp.size
    show_measured(parts.command, x)
    for i in range(n):
        e, ed = x[i] - x_ref[i], x[n + i] - x_ref[n + i]
        parts.command.tau[i] = -parts.kp[i] * e - parts.kd[i] * ed


run_ticks = closed_loop(update)
