"""Concurrent learning: Slotine and Li's law, and the same parameters learned from a record.

    θ̂' = −Γ (Yᵀ s + σ θ̂) + k Γ Σᵢ 𝒴ᵢᵀ (𝒰ᵢ − 𝒴ᵢ θ̂)

Each pair of the record is the motion M q̈ + C q̇ + G + F q̇ = τ integrated over a window, which needs
no acceleration (`regressor` says how):

    𝒰 = ∫ τ dt,   𝒴 = [Y_m]_start^end + ∫ Y_l dt,    M q̇ = Y_m θ,   −Cᵀ q̇ + G + F q̇ = Y_l θ

Windows follow one another; ∫ Y_l is the trapezoidal rule on the sensors' samples, ∫ τ is exact for
a held torque. Once the record has been excited enough for λ_min(Σ 𝒴ᵀ𝒴) > 0, θ̂ → θ exponentially,
with the motion at hand exciting or not.

The record lives in the coordinates φ = Γ^(−½) θ, in which λ_min is the slowest rate of learning.

N.B. without `max_age` the record never grows old: what it says of a robot that has since taken up a
load is wrong, and pulls against the first term.

Source: Chowdhary, Johnson, "Concurrent learning for convergence in adaptive control without
persistency of excitation", IEEE Conf. Decision and Control 2010; Parikh, Kamalapurkar, Dixon,
"Integral concurrent learning: adaptive control with parameter convergence using finite
excitation", Int. J. Adaptive Control and Signal Processing 33(12), 2019.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import compiled, inner
from dnnmso_mj.controllers import Command, CompiledTicks, Inputs
from dnnmso_mj.controllers.measured import empty_command
from dnnmso_mj.controllers.slotine_li import Law, adapt, build_law, show, track
from dnnmso_mj.history_stack import EMPTY, HistoryStack, build_stack, learn, offer, refresh
from dnnmso_mj.plant import NominalModel
from dnnmso_mj.regressor import drift, momentum, momentum_loss, refuse_other_arms
from dnnmso_mj.scenario import ConcurrentLearning
from dnnmso_mj.scenario.adaptive import N_PARAMETERS
from dnnmso_mj.tick import closed_loop

Array = np.ndarray


class Window(NamedTuple):
    """The pair that is being integrated."""

    Y: Array  # (2, 7) ∫ Y_l dt − Y_m at the start; at the end 𝒴 Γ^½
    U: Array  # (2,) N·m·s, ∫ τ dt
    loss: Array  # (2, 7) Y_l at the last tick
    here: Array  # (2, 7) scratch
    scale: Array  # Γ^½ (7,)
    phi: Array  # Γ^(−½) θ̂ (7,)
    periods: Array  # (1,) int64: integrated so far; −1 before the first tick
    length: int  # periods


class Parts(NamedTuple):
    """The controller's arrays."""

    law: Law
    window: Window
    stack: HistoryStack
    command: Command


class ConcurrentLearningController:
    """Adaptive control of a two-link arm with integral concurrent learning.

    Args:
        spec: gains of the scenario.
        dt: control period (s).
        nominal: asked for the form of the robot alone, never for its numbers.

    Raises:
        ScenarioError: the robot is not a two-link arm in a vertical plane.
    """

    n_layers = 0

    def __init__(self, spec: ConcurrentLearning, dt: float, nominal: NominalModel) -> None:
        refuse_other_arms(nominal, spec.kind)
        law = build_law(spec, dt)
        length = max(1, round(spec.window / dt))
        oldest = EMPTY if spec.max_age is None else max(1, round(spec.max_age / (length * dt)))
        stack = build_stack((spec.stack, 2, N_PARAMETERS), dt * spec.k_CL, oldest)
        Y, loss, here = np.zeros((3, 2, N_PARAMETERS))
        window = Window(
            Y=Y,
            U=np.zeros(2),
            loss=loss,
            here=here,
            scale=np.sqrt(law.Gamma),
            phi=np.zeros(N_PARAMETERS),
            periods=np.array([-1]),
            length=length,
        )
        self._parts = Parts(law, window, stack, empty_command(2))
        self.ticks = CompiledTicks(run_ticks, self._parts, ConcurrentLearningController.update)

    def reset(self, x: Array) -> None:
        self._parts.window.periods[0] = -1

    def update(self, inputs: Inputs) -> Command:
        update(self._parts, inputs)
        return self._parts.command

    def dynamics(self, x: Array) -> Array:
        out = np.zeros(2)
        drift(self._parts.law.theta, x, out)
        return out

    def state(self) -> dict[str, Array]:
        window, stack = self._parts.window, self._parts.stack
        kept = {
            "theta": self._parts.law.theta,
            "window_Y": window.Y,
            "window_U": window.U,
            "window_loss": window.loss,
            "window_periods": window.periods,
            "stack_Y": stack.Y,
            "stack_U": stack.U,
            "stack_age": stack.age,
        }
        return {name: array.copy() for name, array in kept.items()}

    def restore(self, state: Mapping[str, Array]) -> None:
        window, stack = self._parts.window, self._parts.stack
        self._parts.law.theta[:] = state["theta"]
        window.Y[:], window.U[:] = state["window_Y"], state["window_U"]
        window.loss[:], window.periods[:] = state["window_loss"], state["window_periods"]
        stack.Y[:], stack.U[:] = state["stack_Y"], state["stack_U"]
        stack.age[:] = state["stack_age"]
        refresh(stack)


@compiled
def record(window: Window, stack: HistoryStack, x: Array, tau: Array, dt: float) -> None:
    """Integrate the period that ends at x (4,) under the torque tau (2,); close a full window."""
    if window.periods[0] >= 0:
        momentum_loss(x, window.here)
        for i in range(2):
            window.U[i] += dt * tau[i]
            for j in range(N_PARAMETERS):
                window.Y[i, j] += 0.5 * dt * (window.loss[i, j] + window.here[i, j])
    window.periods[0] += 1
    if window.periods[0] == window.length:
        momentum(x, window.here)
        for i in range(2):
            for j in range(N_PARAMETERS):
                window.Y[i, j] = (window.Y[i, j] + window.here[i, j]) * window.scale[j]
        offer(stack, window.Y, window.U)
        window.periods[0] = 0
    momentum_loss(x, window.loss)
    if window.periods[0] == 0:
        momentum(x, window.here)
        for i in range(2):
            window.U[i] = 0.0
            for j in range(N_PARAMETERS):
                window.Y[i, j] = -window.here[i, j]


@compiled
def recall(law: Law, window: Window, stack: HistoryStack) -> None:
    """One period of what the record says of θ̂."""
    for j in range(N_PARAMETERS):
        window.phi[j] = law.theta[j] / window.scale[j]
    learn(stack, window.phi)
    for j in range(N_PARAMETERS):
        law.theta[j] = window.phi[j] * window.scale[j]


@inner
def update(parts: Parts, inputs: Inputs) -> None:
    """One tick of the law above."""
    law, window, stack, command = parts.law, parts.window, parts.stack, parts.command
    track(law, inputs.x, inputs.x_ref, inputs.xd_ref, command.tau)
    show(law, inputs.x, command.x_hat, command.f_hat)
    if inputs.frozen[0] == 0:
        record(window, stack, inputs.x, inputs.tau, law.dt)
        adapt(law)
        recall(law, window, stack)
    else:
        window.periods[0] = -1  # what moves meanwhile is not recorded


run_ticks = closed_loop(update)
