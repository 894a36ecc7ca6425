"""The paper's controller with the network off: what feedback and inversion do alone.

    f̂ = [q̇; 0]        (or all zero with `kinematics: false`)

With B = [0; M⁻¹] of the true inertia this is a PD of gains K + λ and λK behind the inversion. The
observer runs along, so that its error shows what a network would have had to learn.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import copy, inner
from dnnmso_mj.controllers import Command, CompiledTicks, Inputs, command_of
from dnnmso_mj.inversion import DynamicInversion, build_inversion, invert
from dnnmso_mj.monitors import Monitors
from dnnmso_mj.observer import (
    StateObserver,
    advance,
    begin,
    build_observer,
    compare,
    correct,
    held,
    hold,
)
from dnnmso_mj.plant import NominalModel
from dnnmso_mj.scenario import NoNetwork
from dnnmso_mj.tick import closed_loop

Array = np.ndarray


class Parts(NamedTuple):
    """The controller's arrays."""

    inversion: DynamicInversion
    observer: StateObserver
    command: Command
    known: int  # how many rows of f̂ are the measured velocity


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
        self._nominal = nominal  # keeps alive what compiled code knows by address
        inversion = build_inversion(spec.inversion, n_joints, nominal.view)
        observer = build_observer(spec.observer, 2 * n_joints, dt)
        command = command_of(inversion, observer.e_obs, Monitors.zeros(0))
        known = n_joints if spec.kinematics else 0
        self._parts = Parts(inversion, observer, command, known)
        self.ticks = CompiledTicks(run_ticks, self._parts, NoNetworkController.update)

    def reset(self, x: Array) -> None:
        begin(self._parts.observer, self._parts.inversion, x)

    def update(self, inputs: Inputs) -> Command:
        update(self._parts, inputs)
        return self._parts.command

    def dynamics(self, x: Array) -> Array:
        return np.zeros(x.size // 2)

    def state(self) -> dict[str, Array]:
        return held(self._parts.observer, self._parts.inversion)

    def restore(self, state: Mapping[str, Array]) -> None:
        hold(self._parts.observer, self._parts.inversion, state)


@inner
def update(parts: Parts, inputs: Inputs) -> None:
    """One tick of the law above."""
    observer, command, x = parts.observer, parts.command, inputs.x
    correct(observer, parts.inversion, inputs.tau)
    compare(observer, x)
    copy(observer.x_hat, command.x_hat)
    for i in range(parts.known):
        command.f_hat[i] = x[parts.known + i]
    invert(parts.inversion, x, inputs.x_ref, inputs.xd_ref, command.f_hat)
    advance(observer, command.f_hat, parts.inversion.Bu)


run_ticks = closed_loop(update)
