"""The paper's controller: a deep network learns all the dynamics while inversion uses it.

    X̂̇ = f̂(X) + B u + K₂ e_a          (Eq. 5, with the stable sign)
    u  = B̄⁻¹ (f* − f̂(X) − K e_r)      (Eq. 10 and slack augmentation)
    W  ← Madam(W, ∂½‖e_a‖²/∂W)         (Alg. 1), where ∂loss/∂f̂ ∝ −e_a

Each tick commands with the weights it has, and then learns from the observer's error.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dnnmso_mj import monitors
from dnnmso_mj.compiling import copy, inner
from dnnmso_mj.controllers import LEARNING, Command, CompiledTicks, Inputs, command_of
from dnnmso_mj.inversion import DynamicInversion, build_inversion, invert
from dnnmso_mj.kernel import Net, forward, output_at, prediction
from dnnmso_mj.learner import KernelLearner, build_learner
from dnnmso_mj.monitors import Watch
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
from dnnmso_mj.scenario import DnnMso
from dnnmso_mj.tick import closed_loop

Array = np.ndarray


class Parts(NamedTuple):
    """The arrays of the compiled controller."""

    inversion: DynamicInversion
    observer: StateObserver
    net: Net
    watch: Watch
    command: Command
    known: int  # how many rows of f̂ are the measured velocity instead of learned


class DnnMsoController:
    """DNN-MSO with dynamic inversion.

    Args:
        spec: gains, network and learning rule of the scenario.
        n_joints: n.
        dt: control period (s).
        seed: of the initial weights.
        nominal: the controller's own model of the robot, read for B alone.
        watch: whether the monitors are kept.
    """

    def __init__(
        self,
        spec: DnnMso,
        n_joints: int,
        dt: float,
        seed: int,
        nominal: NominalModel,
        *,
        watch: bool = True,
    ) -> None:
        n = n_joints
        self._known = n if spec.network.outputs == "kinematic" else 0
        self._nominal = nominal  # keeps alive what compiled code knows by address
        self.inversion = build_inversion(spec.inversion, n, nominal.view)
        self.observer = build_observer(spec.observer, 2 * n, dt)
        n_out = 2 * n - self._known
        self.learner = build_learner(spec.network, spec.rule, 2 * n, n_out, seed, watch=watch)
        self.n_layers = self.learner.shape.n_layers
        self.command = command_of(self.inversion, self.observer.e_obs, self.learner.monitors)
        self.ticks = None
        if isinstance(self.learner, KernelLearner):
            parts = Parts(
                inversion=self.inversion,
                observer=self.observer,
                net=self.learner.net,
                watch=self.learner.watch,
                command=self.command,
                known=self._known,
            )
            self.ticks = CompiledTicks(run_ticks, parts, DnnMsoController.update)

    def reset(self, x: Array) -> None:
        begin(self.observer, self.inversion, x)

    def update(self, inputs: Inputs) -> Command:
        if self.ticks is not None:
            update(self.ticks.parts, inputs)
        else:
            self._update_with_any_learner(inputs)
        return self.command

    def _update_with_any_learner(self, inputs: Inputs) -> None:
        """What `update` below compiles."""
        observer, command, known, x = self.observer, self.command, self._known, inputs.x
        correct(observer, self.inversion, inputs.tau)
        compare(observer, x)
        copy(observer.x_hat, command.x_hat)
        command.f_hat[:known] = x[known : 2 * known]
        command.f_hat[known:] = self.learner.predict(x)
        invert(self.inversion, x, inputs.x_ref, inputs.xd_ref, command.f_hat)
        if inputs.frozen[0] == LEARNING:
            self.learner.learn(-observer.e_obs[known:])
        advance(observer, command.f_hat, self.inversion.Bu)

    def dynamics(self, x: Array) -> Array:
        return self.learner.predict(x)[-x.size // 2 :].copy()

    def state(self) -> dict[str, Array]:
        return {**held(self.observer, self.inversion), **self.learner.state()}

    def restore(self, state: Mapping[str, Array]) -> None:
        hold(self.observer, self.inversion, state)
        self.learner.restore(state)


@inner
def update(parts: Parts, inputs: Inputs) -> None:
    """One tick of the law above."""
    observer, command, net, known = parts.observer, parts.command, parts.net, parts.known
    x = inputs.x
    correct(observer, parts.inversion, inputs.tau)
    compare(observer, x)
    copy(observer.x_hat, command.x_hat)
    forward(net, x)
    output = prediction(net)
    for i in range(known):
        command.f_hat[i] = x[known + i]
    for i in range(output.size):
        command.f_hat[known + i] = output[i]
    invert(parts.inversion, x, inputs.x_ref, inputs.xd_ref, command.f_hat)
    if inputs.frozen[0] == LEARNING:
        delta = output_at(net)
        for i in range(output.size):
            net.deltas[delta + i] = -observer.e_obs[known + i]
        monitors.learn(net, parts.watch, command.monitors)
    advance(observer, command.f_hat, parts.inversion.Bu)


run_ticks = closed_loop(update)
