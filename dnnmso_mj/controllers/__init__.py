"""Controllers: one a file. Each reads a measurement and a reference, and commands torque."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from dnnmso_mj.inversion import DynamicInversion
from dnnmso_mj.learner import Monitors
from dnnmso_mj.observer import StateObserver
from dnnmso_mj.plant import Mjcf, NominalModel
from dnnmso_mj.scenario import ClassicalMso, DnnMso, NoNetwork, Scenario

Array = np.ndarray


@dataclass
class Command:
    """What a controller decided in one tick, and what is worth logging of it.

    Arrays belong to the controller and are overwritten by its next update.
    """

    tau: Array
    """Torque (n,) N·m."""
    Bu: Array
    """B τ (2n,): the effect of `tau` as the controller sees it."""
    x_hat: Array
    """Observer state X̂ (2n,) that e_obs was taken from."""
    f_hat: Array
    """Learned (or known) dynamics f̂ (2n,)."""
    e_obs: Array
    """Observer error X − X̂ (2n,)."""
    monitors: Monitors = field(default_factory=lambda: Monitors.zeros(0))
    """Monitors of the network's update; empty without a network."""

    @classmethod
    def of(cls, inversion: DynamicInversion, observer: StateObserver, f_hat: Array) -> Command:
        """A command that shows what these parts hold, without copying it on each tick."""
        return cls(
            tau=inversion.tau,
            Bu=inversion.Bu,
            x_hat=np.zeros_like(observer.x_hat),
            f_hat=f_hat,
            e_obs=observer.e_obs,
        )


class Controller(Protocol):
    """What the loop asks of a controller; `n_layers` weight layers, 0 without a network."""

    n_layers: int

    def reset(self, x: Array) -> None:
        """Start from the measured state x = [q; q̇] (2n,)."""

    def update(self, x: Array, x_ref: Array, xd_ref: Array) -> Command:
        """Command the torque for measured x, reference x_ref and its derivative, each (2n,)."""

    def effect(self, tau: Array) -> Array:
        """B τ (2n,) of a torque other than the commanded one, at the state of the last update."""

    def state(self) -> dict[str, Array]:
        """Everything that the next update depends on."""

    def restore(self, state: Mapping[str, Array]) -> None:
        """Go on from a `state`."""


def build_controller(scenario: Scenario, mjcf: Mjcf) -> Controller:
    """The controller that a scenario names, with its own nominal model of the robot."""
    from dnnmso_mj.controllers.classical_mso import ClassicalMsoController
    from dnnmso_mj.controllers.dnn_mso import DnnMsoController
    from dnnmso_mj.controllers.no_network import NoNetworkController

    nominal = NominalModel(scenario, mjcf)
    spec, n, dt = scenario.controller, scenario.n_joints, scenario.dt
    match spec:
        case DnnMso():
            return DnnMsoController(spec, n, dt, scenario.seed, nominal)
        case NoNetwork():
            return NoNetworkController(spec, n, dt, nominal)
        case ClassicalMso():
            return ClassicalMsoController(spec, n, dt, scenario.seed, nominal)
