"""Active disturbance rejection: a linear extended state observer and its disturbance cancelled.

Each joint is taken for q̈ = z₃ + B₂ τ, all that is unknown lumped into z₃.

    observer    ż₁ = z₂ + l₁ (q − z₁),   ż₂ = z₃ + B₂ τ_acted + l₂ (q − z₁),   ż₃ = l₃ (q − z₁)
    command     τ = B₂⁻¹ (q̈_ref + ω_c² (q_ref − z₁) + 2 ω_c (q̇_ref − z₂) − z₃)

The observer's triple pole is at −ω_o. It is sampled exactly, as a current estimator: predict over
the period under the torque that acted in it, then correct by the new reading with gains

    [1 − p³,  3 (1 − p)² (1 + p)/(2 dt),  (1 − p)³/dt²],   p = exp(−ω_o dt),

which put all three of its poles at p. It reads the angle alone, no velocity. B₂ of the past period
is taken at its end.

Gao, "Scaling and bandwidth-parameterization based controller tuning", American Control Conference,
2003. Miklosovic, Radke and Gao, "Discrete implementation and generalization of the extended state
observer", American Control Conference, 2006.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import inner
from dnnmso_mj.controllers import MODEL_ALONE, Command, CompiledTicks, Inputs
from dnnmso_mj.controllers.measured import empty_command
from dnnmso_mj.effectiveness import (
    Effectiveness,
    acceleration_of,
    build_effectiveness,
    evaluate,
    torque_for,
)
from dnnmso_mj.plant import NominalModel
from dnnmso_mj.scenario import Adrc, expand
from dnnmso_mj.tick import closed_loop

Array = np.ndarray


class ExtendedObserver(NamedTuple):
    """The observer at the control period."""

    z: Array  # (3, n) rad, rad/s, rad/s²
    gain: Array  # (3, n)
    effect: Array  # B₂ τ_acted (n,) rad/s²
    dt: float  # s


class Parts(NamedTuple):
    """The controller's arrays."""

    observer: ExtendedObserver
    bandwidth: Array  # ω_c (n,) 1/s
    wanted: Array  # (n,) rad/s²
    effectiveness: Effectiveness
    command: Command


def observer_gain(bandwidth: Array, dt: float) -> Array:
    """Gains (3, n) of the sampled observer for ω_o (n,) 1/s and period dt (s)."""
    p = np.exp(-bandwidth * dt)
    return np.stack(
        [1.0 - p**3, 1.5 * (1.0 - p) ** 2 * (1.0 + p) / dt, (1.0 - p) ** 3 / dt**2],
    )


class AdrcController:
    """Linear ADRC; while frozen as MODEL_ALONE the disturbance z₃ is not cancelled.

    Args:
        spec: bandwidths of the scenario.
        n_joints: n.
        dt: control period (s).
        nominal: the controller's own model of the robot, read for B₂ alone.
    """

    n_layers = 0

    def __init__(self, spec: Adrc, n_joints: int, dt: float, nominal: NominalModel) -> None:
        n = n_joints
        self._nominal = nominal  # keeps alive what compiled code knows by address
        gain = observer_gain(expand(spec.observer_bandwidth, n), dt)
        self._parts = Parts(
            observer=ExtendedObserver(np.zeros((3, n)), gain, np.zeros(n), dt),
            bandwidth=expand(spec.controller_bandwidth, n),
            wanted=np.zeros(n),
            effectiveness=build_effectiveness(spec.effectiveness, n, nominal.view),
            command=empty_command(n),
        )
        self.ticks = CompiledTicks(run_ticks, self._parts, AdrcController.update)

    def reset(self, x: Array) -> None:
        z, n = self._parts.observer.z, x.size // 2
        # One period before the start, since the first update predicts over one.
        z[0], z[1], z[2] = x[:n] - self._parts.observer.dt * x[n:], x[n:], 0.0

    def update(self, inputs: Inputs) -> Command:
        update(self._parts, inputs)
        return self._parts.command

    def dynamics(self, x: Array) -> Array:
        return np.zeros(x.size // 2)

    def state(self) -> dict[str, Array]:
        return {"z": self._parts.observer.z.copy()}

    def restore(self, state: Mapping[str, Array]) -> None:
        self._parts.observer.z[:] = state["z"]


@inner
def predict(observer: ExtendedObserver, effect: Array) -> None:
    """Go on by one period under the acceleration `effect` = B₂ τ_acted (n,) and z₃."""
    z, dt = observer.z, observer.dt
    for i in range(effect.size):
        acceleration = z[2, i] + effect[i]
        z[0, i] += dt * z[1, i] + 0.5 * dt * dt * acceleration
        z[1, i] += dt * acceleration


@inner
def correct(observer: ExtendedObserver, q: Array) -> None:
    """Take in the reading q (n,) rad."""
    z, gain = observer.z, observer.gain
    for i in range(q.size):
        innovation = q[i] - z[0, i]
        for row in range(3):
            z[row, i] += gain[row, i] * innovation


@inner
def update(parts: Parts, inputs: Inputs) -> None:
    """One tick of the law above."""
    observer, command, effectiveness = parts.observer, parts.command, parts.effectiveness
    x, x_ref, n = inputs.x, inputs.x_ref, parts.wanted.size
    z = observer.z
    evaluate(effectiveness, x[:n])
    acceleration_of(effectiveness, inputs.tau, observer.effect)
    predict(observer, observer.effect)
    for i in range(n):
        command.x_hat[i], command.x_hat[n + i] = z[0, i], z[1, i]
        command.e_obs[i], command.e_obs[n + i] = x[i] - z[0, i], x[n + i] - z[1, i]
    correct(observer, x[:n])
    for i in range(n):
        w = parts.bandwidth[i]
        unknown = 0.0 if inputs.frozen[0] == MODEL_ALONE else z[2, i]
        feedback = w * w * (x_ref[i] - z[0, i]) + 2.0 * w * (x_ref[n + i] - z[1, i])
        parts.wanted[i] = inputs.xd_ref[n + i] + feedback - unknown
        command.f_hat[i], command.f_hat[n + i] = x[n + i], unknown
    torque_for(effectiveness, parts.wanted, command.tau)


run_ticks = closed_loop(update)
