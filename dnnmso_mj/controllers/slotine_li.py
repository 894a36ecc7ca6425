"""Adaptive control by Slotine and Li: the form of the robot is known, its numbers are not.

    s = ė + λ e,   q̇_r = q̇_ref − λ e,   e = q − q_ref
    τ = Y(q, q̇, q̇_r, q̈_r) θ̂ − K_D s
    θ̂' = −Γ (Yᵀ s + σ θ̂)

With σ = 0, V = ½ sᵀ M s + ½ θ̃ᵀ Γ⁻¹ θ̃ falls, V̇ = −sᵀ (K_D + F) s: tracking is asymptotic, whether
or not θ̂ finds the truth. σ > 0 is the leakage that holds θ̂ where noise would make it drift.

Source: Slotine, Li, "On the adaptive control of robot manipulators", Int. J. Robotics Research
6(3), 1987; leakage: Ioannou, Kokotovic, "Instability analysis and improvement of robustness of
adaptive control", Automatica 20(5), 1984.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import compiled, copy, inner
from dnnmso_mj.controllers import Command, CompiledTicks, Inputs
from dnnmso_mj.controllers.measured import empty_command
from dnnmso_mj.plant import NominalModel
from dnnmso_mj.regressor import drift, refuse_other_arms, regressor
from dnnmso_mj.scenario import ConcurrentLearning, SlotineLi, expand
from dnnmso_mj.scenario.adaptive import N_PARAMETERS
from dnnmso_mj.tick import closed_loop

Array = np.ndarray


class Law(NamedTuple):
    """The arrays of the adaptive law."""

    theta: Array  # θ̂ (7,)
    Y: Array  # (2, 7)
    s: Array  # (2,) rad/s
    v: Array  # q̇_r (2,)
    a: Array  # q̈_r (2,)
    K_D: Array  # (2,) N·m·s/rad
    Gamma: Array  # (7,)
    lam: float  # 1/s
    sigma: float
    dt: float  # s


class Parts(NamedTuple):
    """The controller's arrays."""

    law: Law
    command: Command


def build_law(spec: SlotineLi | ConcurrentLearning, dt: float) -> Law:
    """The law of a scenario at its first estimates."""
    theta = np.zeros(N_PARAMETERS) if spec.theta is None else np.array(spec.theta)
    s, v, a = np.zeros((3, 2))
    return Law(
        theta=theta,
        Y=np.zeros((2, N_PARAMETERS)),
        s=s,
        v=v,
        a=a,
        K_D=expand(spec.K_D, 2),
        Gamma=expand(spec.Gamma, N_PARAMETERS),
        lam=spec.lam,
        sigma=spec.sigma,
        dt=dt,
    )


class SlotineLiController:
    """Passivity-based adaptive control of a two-link arm.

    Args:
        spec: gains of the scenario.
        dt: control period (s).
        nominal: asked for the form of the robot alone, never for its numbers.

    Raises:
        ScenarioError: the robot is not a two-link arm in a vertical plane.
    """

    n_layers = 0

    def __init__(self, spec: SlotineLi, dt: float, nominal: NominalModel) -> None:
        refuse_other_arms(nominal, spec.kind)
        self._parts = Parts(build_law(spec, dt), empty_command(2))
        self.ticks = CompiledTicks(run_ticks, self._parts, SlotineLiController.update)

    def reset(self, x: Array) -> None:
        """Nothing depends on the state before the first tick."""

    def update(self, inputs: Inputs) -> Command:
        update(self._parts, inputs)
        return self._parts.command

    def dynamics(self, x: Array) -> Array:
        out = np.zeros(2)
        drift(self._parts.law.theta, x, out)
        return out

    def state(self) -> dict[str, Array]:
        return {"theta": self._parts.law.theta.copy()}

    def restore(self, state: Mapping[str, Array]) -> None:
        self._parts.law.theta[:] = state["theta"]


@compiled
def track(law: Law, x: Array, x_ref: Array, xd_ref: Array, tau: Array) -> None:
    """τ (2,) with the present θ̂; leaves s and Y for `adapt`."""
    for i in range(2):
        e, ed = x[i] - x_ref[i], x[2 + i] - x_ref[2 + i]
        law.s[i] = ed + law.lam * e
        law.v[i] = x_ref[2 + i] - law.lam * e
        law.a[i] = xd_ref[2 + i] - law.lam * ed
    regressor(x, law.v, law.a, law.Y)
    for i in range(2):
        tau[i] = -law.K_D[i] * law.s[i]
        for j in range(law.theta.size):
            tau[i] += law.Y[i, j] * law.theta[j]


@compiled
def adapt(law: Law) -> None:
    """One period of θ̂' = −Γ (Yᵀ s + σ θ̂)."""
    for j in range(law.theta.size):
        rate = law.Y[0, j] * law.s[0] + law.Y[1, j] * law.s[1] + law.sigma * law.theta[j]
        law.theta[j] -= law.dt * law.Gamma[j] * rate


@compiled
def show(law: Law, x: Array, x_hat: Array, f_hat: Array) -> None:
    """X̂ = X and f̂ = [q̇; what the estimates say], each (4,), for the log."""
    copy(x, x_hat)
    f_hat[0], f_hat[1] = x[2], x[3]
    drift(law.theta, x, f_hat[2:])


@inner
def update(parts: Parts, inputs: Inputs) -> None:
    """One tick of the law above."""
    law, command = parts.law, parts.command
    track(law, inputs.x, inputs.x_ref, inputs.xd_ref, command.tau)
    show(law, inputs.x, command.x_hat, command.f_hat)
    if inputs.frozen[0] == 0:
        adapt(law)


run_ticks = closed_loop(update)
