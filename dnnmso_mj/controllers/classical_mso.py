"""The classical modified state observer: known dynamics plus a learned uncertainty (Eq. 4).

    X̂̇ = f(X̂) + B (u + d̂(X)) + K₂ e_a
    u  = B̄⁻¹ (f* − f(X) − B d̂(X) − K e_r)

f and B come from the nominal model, which a scenario may set wrong; d̂ (n,) N·m is learned from
∂½‖e_a‖²/∂d̂ ∝ −Bᵀ e_a.

N.B. the paper prints Eq. 4 with an unbalanced parenthesis, which leaves it open whether B
multiplies K₂, and with the unstable sign; K₂ stands alone here, as in the DNN-MSO. The works it
cites train d̂ by gradient laws of their own, as `rbf_mso` does; here Madam trains it, so that only
the model differs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dnnmso_mj import monitors
from dnnmso_mj.compiling import copy, inner
from dnnmso_mj.controllers import LEARNING, Command, CompiledTicks, Inputs, command_of
from dnnmso_mj.inversion import DynamicInversion, build_inversion, invert, solve_spd
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
from dnnmso_mj.plant import Nominal, NominalModel, bias, inertia
from dnnmso_mj.scenario import ClassicalMso
from dnnmso_mj.scenario import Inversion as InversionSpec
from dnnmso_mj.scenario import Observer as ObserverSpec
from dnnmso_mj.tick import closed_loop

Array = np.ndarray


class Law(NamedTuple):
    """The controller's arrays but for its command and its network."""

    nominal: Nominal
    inversion: DynamicInversion
    observer: StateObserver
    f_obs: Array  # (2n,) what the observer integrates
    learned: Array  # (n,) B₂ d̂
    delta: Array  # (n,) ∂loss/∂d̂
    free: Array  # (n,) scratch
    L: Array  # (n, n) scratch


class Parts(NamedTuple):
    """The arrays of the compiled controller."""

    law: Law
    command: Command
    net: Net
    watch: Watch


class ClassicalMsoController:
    """MSO with known dynamics and a learned matched uncertainty.

    Args:
        spec: gains, network and learning rule of the scenario.
        n_joints: n.
        dt: control period (s).
        seed: of the initial weights.
        nominal: the controller's own model of the robot, read for f and B.
        watch: whether the monitors are kept.
    """

    def __init__(
        self,
        spec: ClassicalMso,
        n_joints: int,
        dt: float,
        seed: int,
        nominal: NominalModel,
        *,
        watch: bool = True,
    ) -> None:
        n = n_joints
        self.learner = build_learner(spec.network, spec.rule, 2 * n, n, seed, watch=watch)
        self.n_layers = self.learner.shape.n_layers
        self._nominal = nominal  # keeps alive what compiled code knows by address
        self._law = law = build_law(spec.inversion, spec.observer, n, dt, nominal)
        e_obs, watched = law.observer.e_obs, self.learner.monitors
        self._command = command_of(law.inversion, e_obs, watched)
        self.ticks = None
        if isinstance(self.learner, KernelLearner):
            parts = Parts(self._law, self._command, self.learner.net, self.learner.watch)
            self.ticks = CompiledTicks(run_ticks, parts, ClassicalMsoController.update)

    def reset(self, x: Array) -> None:
        begin(self._law.observer, self._law.inversion, x)

    def update(self, inputs: Inputs) -> Command:
        if self.ticks is not None:
            update(self.ticks.parts, inputs)
        else:
            d_hat = self.learner.predict(inputs.x)
            command_with(self._law, self._command, d_hat, inputs)
            if inputs.frozen[0] == LEARNING:
                self.learner.learn(self._law.delta)
        return self._command

    def dynamics(self, x: Array) -> Array:
        return drift(self._law, x, self.learner.predict(x).astype(float))

    def state(self) -> dict[str, Array]:
        return {**held(self._law.observer, self._law.inversion), **self.learner.state()}

    def restore(self, state: Mapping[str, Array]) -> None:
        hold(self._law.observer, self._law.inversion, state)
        self.learner.restore(state)


def build_law(
    inversion: InversionSpec, observer: ObserverSpec, n: int, dt: float, nominal: NominalModel
) -> Law:
    """The law for n joints, with the controller's own model, at control period dt (s)."""
    return Law(
        nominal=nominal.view,
        inversion=build_inversion(inversion, n, nominal.view),
        observer=build_observer(observer, 2 * n, dt),
        f_obs=np.zeros(2 * n),
        learned=np.zeros(n),
        delta=np.zeros(n),
        free=np.zeros(n),
        L=np.zeros((n, n)),
    )


def drift(law: Law, x: Array, d_hat: Array) -> Array:
    """−M⁻¹(V + G) + B₂ d̂ (n,): the accelerations without torque at x (2n,), for d̂ (n,) there."""
    n = d_hat.size
    learned, known = np.zeros(n), np.zeros(2 * n)
    _known(law, x, known)
    solve_spd(law.nominal.M, d_hat, learned, law.L)
    return known[n:] + learned


@inner
def command_with(law: Law, command: Command, d_hat: Array, inputs: Inputs) -> None:
    """Everything of a tick but the network: command with d̂ (n,), leave ∂loss/∂d̂ in `delta`."""
    n, observer, x = d_hat.size, law.observer, inputs.x
    correct(observer, law.inversion, inputs.tau)
    compare(observer, x)
    copy(observer.x_hat, command.x_hat)
    _known(law, x, command.f_hat)
    for i in range(n):
        law.free[i] = d_hat[i]
    solve_spd(law.nominal.M, law.free, law.learned, law.L)
    for i in range(n):
        command.f_hat[n + i] += law.learned[i]
    invert(law.inversion, x, inputs.x_ref, inputs.xd_ref, command.f_hat)
    solve_spd(law.nominal.M, observer.e_obs[n:], law.delta, law.L)  # B₂ is symmetric
    for i in range(n):
        law.delta[i] = -law.delta[i]
    _known(law, observer.x_hat, law.f_obs)
    for i in range(n):
        law.f_obs[n + i] += law.learned[i]
    advance(observer, law.f_obs, law.inversion.Bu)


@inner
def _known(law: Law, x: Array, out: Array) -> None:
    """f(x) = [q̇; −M⁻¹(V + G)] (2n,) of the nominal model, whose M(q) stays behind."""
    n = law.free.size
    inertia(law.nominal, x[:n])
    bias(law.nominal, x[:n], x[n:])
    solve_spd(law.nominal.M, law.nominal.bias, law.free, law.L)
    for i in range(n):
        out[i], out[n + i] = x[n + i], -law.free[i]


@inner
def update(parts: Parts, inputs: Inputs) -> None:
    """One tick of the law above."""
    law, net = parts.law, parts.net
    forward(net, inputs.x)
    command_with(law, parts.command, prediction(net), inputs)
    if inputs.frozen[0] == LEARNING:
        delta = output_at(net)
        for i in range(law.delta.size):
            net.deltas[delta + i] = law.delta[i]
        monitors.learn(net, parts.watch, parts.command.monitors)


run_ticks = closed_loop(update)
