"""DNN-MSO in a backstepping law: the paper's future work, for drives with a lag too.

    X̂̇ = f̂(X) + B τ + K₂ e_a          (Eq. 5, with the stable sign and the torque that acted)
    τ_cmd: `dnnmso_mj.backstepping` with f̂ + K₂ e_a
    W  ← Madam(W, ∂½‖e_a‖²/∂W)         (Alg. 1)

N.B. the upper rows of f̂ are x₂, or x₂ + d̂₁ with a learned d̂₁ (`network.outputs: full`). The paper's
network learns them whole; a law that takes x₂ for its handle on x₁ is then lost, since before it
has learned the network says nothing of x₂ there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dnnmso_mj import monitors
from dnnmso_mj.backstepping import Law, act, build_law, held, observe
from dnnmso_mj.compiling import copy, inner
from dnnmso_mj.controllers import LEARNING, MODEL_ALONE, Command, CompiledTicks, Inputs
from dnnmso_mj.kernel import Net, forward, output_at, prediction
from dnnmso_mj.learner import KernelLearner, build_learner
from dnnmso_mj.monitors import Watch
from dnnmso_mj.observer import start
from dnnmso_mj.plant import NominalModel
from dnnmso_mj.scenario import Backstepping
from dnnmso_mj.tick import closed_loop

Array = np.ndarray


class Parts(NamedTuple):
    """The arrays of the compiled controller."""

    law: Law
    net: Net
    watch: Watch
    command: Command
    known: int  # how many rows of f̂ are not learned


class BacksteppingController:
    """DNN-MSO with command filtered backstepping.

    Args:
        spec: gains, filters, network and learning rule of the scenario.
        n_joints: n.
        dt: control period (s).
        seed: of the initial weights.
        nominal: the controller's own model of the robot, read for B alone.
        watch: whether the monitors are kept.
    """

    def __init__(
        self,
        spec: Backstepping,
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
        n_out = 2 * n - self._known
        self.learner = build_learner(spec.network, spec.rule, 2 * n, n_out, seed, watch=watch)
        self.n_layers = self.learner.shape.n_layers
        self.law = build_law(spec, n, dt, nominal.view)
        self.command = Command(
            tau=self.law.tau,
            Bu=self.law.Bu,
            x_hat=np.zeros(2 * n),
            f_hat=self.law.f_hat,
            e_obs=self.law.observer.e_obs,
            monitors=self.learner.monitors,
        )
        self.ticks = None
        if isinstance(self.learner, KernelLearner):
            net, watching = self.learner.net, self.learner.watch
            parts = Parts(self.law, net, watching, self.command, self._known)
            self.ticks = CompiledTicks(run_ticks, parts, BacksteppingController.update)

    def reset(self, x: Array) -> None:
        start(self.law.observer, x)
        self.law.fresh[0] = 1

    def update(self, inputs: Inputs) -> Command:
        if self.ticks is not None:
            update(self.ticks.parts, inputs)
        else:
            self._update_with_any_learner(inputs)
        return self.command

    def _update_with_any_learner(self, inputs: Inputs) -> None:
        """What `update` below compiles."""
        law, known = self.law, self._known
        observe(law, inputs)
        copy(law.observer.x_hat, self.command.x_hat)
        law.f_hat[known:] += self.learner.predict(inputs.x)
        act(law, inputs, inputs.frozen[0] != MODEL_ALONE)
        if inputs.frozen[0] == LEARNING:
            self.learner.learn(-law.observer.e_obs[known:])

    def dynamics(self, x: Array) -> Array:
        return self.learner.predict(x)[-x.size // 2 :].copy()

    def state(self) -> dict[str, Array]:
        arrays = {name: array.copy() for name, array in held(self.law).items()}
        return {**arrays, **self.learner.state()}

    def restore(self, state: Mapping[str, Array]) -> None:
        for name, array in held(self.law).items():
            array[:] = state[name]
        self.learner.restore(state)


@inner
def update(parts: Parts, inputs: Inputs) -> None:
    """One tick of the law above."""
    law, net, known = parts.law, parts.net, parts.known
    observe(law, inputs)
    copy(law.observer.x_hat, parts.command.x_hat)
    forward(net, inputs.x)
    output = prediction(net)
    for i in range(output.size):
        law.f_hat[known + i] += output[i]
    act(law, inputs, inputs.frozen[0] != MODEL_ALONE)
    if inputs.frozen[0] == LEARNING:
        delta = output_at(net)
        for i in range(output.size):
            net.deltas[delta + i] = -law.observer.e_obs[known + i]
        monitors.learn(net, parts.watch, parts.command.monitors)


run_ticks = closed_loop(update)
