"""Controllers: one a file. Each reads a measurement and a reference, and commands torque."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from dnnmso_mj.inversion import DynamicInversion
from dnnmso_mj.monitors import Monitors
from dnnmso_mj.plant import Mjcf, NominalModel
from dnnmso_mj.scenario import (
    Backstepping,
    ClassicalMso,
    ConcurrentLearning,
    DnnMso,
    DnnMsoReplay,
    External,
    LewisNn,
    NoNetwork,
    Policy,
    RbfMso,
    Scenario,
    SlotineLi,
)
from dnnmso_mj.scenario.rivals import Rival

if TYPE_CHECKING:
    from dnnmso_mj.tick import Loop

Array = np.ndarray


# Values of `Inputs.frozen`.
LEARNING = 0
MODEL_FROZEN = 1  # weights and adapted parameters stay as they are
MODEL_ALONE = 2  # and what estimates the disturbance of the moment is left out


class Inputs(NamedTuple):
    """What a controller is told in one tick; arrays, overwritten by the loop before the next."""

    x: Array  # what the sensors say of [q; q̇] (2n,)
    tau: Array  # what the drives say acted in the period before (n,) N·m; zero before the first
    x_ref: Array  # reference (2n,), of `lookahead` s ahead of the tick
    xd_ref: Array  # its derivative [q̇_ref; q̈_ref] (2n,)
    frozen: Array  # (1,) int64, one of the above

    @classmethod
    def zeros(cls, n_joints: int) -> Inputs:
        """All zero, and learning."""
        x, x_ref, xd_ref = np.zeros((3, 2 * n_joints))
        return cls(x, np.zeros(n_joints), x_ref, xd_ref, np.zeros(1, np.int64))

    @property
    def q(self) -> Array:
        """Measured angles (n,) rad."""
        return self.x[: self.tau.size]

    @property
    def qd(self) -> Array:
        """Measured velocities (n,) rad/s."""
        return self.x[self.tau.size :]

    @property
    def q_ref(self) -> Array:
        """Desired angles (n,) rad."""
        return self.x_ref[: self.tau.size]

    @property
    def qd_ref(self) -> Array:
        """Desired velocities (n,) rad/s."""
        return self.x_ref[self.tau.size :]

    @property
    def qdd_ref(self) -> Array:
        """Desired accelerations (n,) rad/s²."""
        return self.xd_ref[self.tau.size :]


class Command(NamedTuple):
    """What a controller decided in one tick, and what is worth logging of it.

    Arrays belong to the controller and are overwritten by its next update.
    """

    tau: Array  # torque (n,) N·m
    Bu: Array  # B τ (2n,): the effect of `tau` as the controller sees it
    x_hat: Array  # observer state X̂ (2n,) that e_obs was taken from
    f_hat: Array  # learned (or known) dynamics f̂ (2n,)
    e_obs: Array  # observer error X − X̂ (2n,)
    monitors: Monitors  # of the network's update; empty without a network


def no_command(like: Command) -> Command:
    """What stands in the log until a controller's first command: zeros, as many as it will have."""
    return Command(
        tau=np.zeros_like(like.tau),
        Bu=np.zeros_like(like.Bu),
        x_hat=np.zeros_like(like.x_hat),
        f_hat=np.zeros_like(like.f_hat),
        e_obs=np.zeros_like(like.e_obs),
        monitors=Monitors(*map(np.zeros_like, like.monitors)),
    )


def command_of(inversion: DynamicInversion, e_obs: Array, monitors: Monitors) -> Command:
    """A command that shows what these parts hold, with its own x_hat and f_hat."""
    x_hat, f_hat = np.zeros((2, e_obs.size))
    return Command(
        tau=inversion.tau,
        Bu=inversion.Bu,
        x_hat=x_hat,
        f_hat=f_hat,
        e_obs=e_obs,
        monitors=monitors,
    )


class CompiledTicks(NamedTuple):
    """A controller's whole ticks as compiled code."""

    run: Loop
    """(world, parts, first, count) -> ticks done; see `tick.closed_loop`."""
    parts: Any
    """The controller's arrays, a NamedTuple."""
    update: Callable[..., Command]
    """The method that `run` stands for: a controller with another `update` is not run by it."""


class Controller(Protocol):
    """What the loop asks of a controller; `n_layers` weight layers, 0 without a network.

    One with an attribute `ticks` of `CompiledTicks` runs without the interpreter.
    """

    n_layers: int

    def reset(self, x: Array) -> None:
        """Start from the measured state x = [q; q̇] (2n,)."""

    def update(self, inputs: Inputs) -> Command:
        """Command the torque of this tick, and learn from it."""

    def dynamics(self, x: Array) -> Array:
        """The drift acceleration f̂₂(x) (n,) that the present model predicts; zeros without one."""

    def state(self) -> dict[str, Array]:
        """Everything that the next update depends on."""

    def restore(self, state: Mapping[str, Array]) -> None:
        """Go on from a `state`."""


def compiled_ticks(controller: Controller) -> CompiledTicks | None:
    """A controller's own compiled ticks; None if it has none, is wrapped, or overrides `update`."""
    ticks: CompiledTicks | None = getattr(controller, "ticks", None)
    method = getattr(controller.update, "__func__", None)
    return ticks if ticks is not None and method is ticks.update else None


def build_controller(scenario: Scenario, mjcf: Mjcf, *, watch: bool = True) -> Controller:
    """The controller that a scenario names, with its own nominal model of the robot.

    Args:
        scenario: the experiment.
        mjcf: the model that it names.
        watch: whether the monitors of the network are kept; they change nothing else.
    """
    from dnnmso_mj.controllers.backstepping import BacksteppingController
    from dnnmso_mj.controllers.classical_mso import ClassicalMsoController
    from dnnmso_mj.controllers.concurrent_learning import ConcurrentLearningController
    from dnnmso_mj.controllers.dnn_mso import DnnMsoController
    from dnnmso_mj.controllers.dnn_mso_replay import DnnMsoReplayController
    from dnnmso_mj.controllers.lewis_nn import LewisNnController
    from dnnmso_mj.controllers.no_network import NoNetworkController
    from dnnmso_mj.controllers.policy import PolicyController
    from dnnmso_mj.controllers.rbf_mso import RbfMsoController
    from dnnmso_mj.controllers.rivals import build_rival
    from dnnmso_mj.controllers.slotine_li import SlotineLiController
    from dnnmso_mj.observation import torque_scale

    nominal = NominalModel(scenario, mjcf)
    n, dt, seed = scenario.n_joints, scenario.dt, scenario.seed
    spec: Any = scenario.controller
    if isinstance(spec, External):
        from dnnmso_mj.external.controller import build_external

        return build_external(scenario, spec, mjcf)
    if isinstance(spec, Rival):
        return build_rival(spec, n, dt, nominal)
    builders: dict[type, Callable[[], Controller]] = {
        DnnMso: lambda: DnnMsoController(spec, n, dt, seed, nominal, watch=watch),
        DnnMsoReplay: lambda: DnnMsoReplayController(spec, n, dt, seed, nominal, watch=watch),
        Backstepping: lambda: BacksteppingController(spec, n, dt, seed, nominal, watch=watch),
        ClassicalMso: lambda: ClassicalMsoController(spec, n, dt, seed, nominal, watch=watch),
        RbfMso: lambda: RbfMsoController(spec, n, dt, seed, nominal),
        LewisNn: lambda: LewisNnController(spec, n, dt, seed, nominal),
        SlotineLi: lambda: SlotineLiController(spec, dt, nominal),
        ConcurrentLearning: lambda: ConcurrentLearningController(spec, dt, nominal),
        NoNetwork: lambda: NoNetworkController(spec, n, dt, nominal),
        Policy: lambda: PolicyController(spec, torque_scale(scenario, spec.torque_scale), dt),
    }
    return builders[type(spec)]()
