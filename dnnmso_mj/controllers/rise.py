"""RISE: robust integral of the sign of the error; continuous torque, no model.

    e₁ = q_ref − q          e₂ = ė₁ + α₁ e₁
    τ = (k_s + 1) e₂ + ν
    ν̇ = (k_s + 1) α₂ e₂ + β sgn(e₂) + α₂ (τ_acted − τ)          ν(0) = −(k_s + 1) e₂(0)

ė₁ takes the velocity as measured: the law needs no acceleration, which enters its proof only as
r = ė₂ + α₂ e₂. For k_s large enough, α₁ > 1/2, α₂ > 1 and β > |Ṅ| + |N̈|/α₂, with N(t) the torque
that the reference itself takes, e₁ and ė₁ go to zero although M, V and G are unknown.

N.B. the last term of ν̇ is not in the source. It is zero unless the drive gives less than was asked;
at a limit it keeps ν from winding up (back-calculation with the integral time 1/α₂). Sampled, sgn
moves the torque by β dt a tick, and leaves an error that shrinks with dt.

Xian, Dawson, de Queiroz and Chen, "A continuous asymptotic tracking control strategy for uncertain
nonlinear systems", IEEE Trans. Automatic Control 49(7), 2004.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import copy, inner
from dnnmso_mj.controllers import MODEL_ALONE, Command, CompiledTicks, Inputs
from dnnmso_mj.controllers.measured import empty_command, show_measured
from dnnmso_mj.scenario import Rise, expand
from dnnmso_mj.tick import closed_loop

Array = np.ndarray


class Parts(NamedTuple):
    """The controller's arrays."""

    gain: Array  # k_s + 1 (n,) N·m·s/rad
    alpha1: Array  # (n,) 1/s
    alpha2: Array  # (n,) 1/s
    beta: Array  # (n,) N·m/s
    nu: Array  # ν (n,) N·m
    asked: Array  # (n,) N·m, commanded in the last tick
    begun: Array  # (1,) 1.0 once ν(0) has been set
    command: Command
    dt: float  # s


class RiseController:
    """RISE feedback; while frozen as MODEL_ALONE the integral keeps its value.

    Args:
        spec: gains of the scenario.
        n_joints: n.
        dt: control period (s).
    """

    n_layers = 0

    def __init__(self, spec: Rise, n_joints: int, dt: float) -> None:
        n = n_joints
        self._parts = Parts(
            gain=expand(spec.ks, n) + 1.0,
            alpha1=expand(spec.alpha1, n),
            alpha2=expand(spec.alpha2, n),
            beta=expand(spec.beta, n),
            nu=np.zeros(n),
            asked=np.zeros(n),
            begun=np.zeros(1),
            command=empty_command(n),
            dt=dt,
        )
        self.ticks = CompiledTicks(run_ticks, self._parts, RiseController.update)

    def reset(self, x: Array) -> None:
        for memory in (self._parts.nu, self._parts.asked, self._parts.begun):
            memory[:] = 0.0

    def update(self, inputs: Inputs) -> Command:
        update(self._parts, inputs)
        return self._parts.command

    def dynamics(self, x: Array) -> Array:
        return np.zeros(x.size // 2)

    def state(self) -> dict[str, Array]:
        parts = self._parts
        return {name: getattr(parts, name).copy() for name in ("nu", "asked", "begun")}

    def restore(self, state: Mapping[str, Array]) -> None:
        for name in ("nu", "asked", "begun"):
            getattr(self._parts, name)[:] = state[name]


@inner
def update(parts: Parts, inputs: Inputs) -> None:
    """One tick of the law above."""
    x, x_ref, n, dt = inputs.x, inputs.x_ref, parts.nu.size, parts.dt
    tau, nu = parts.command.tau, parts.nu
    adapting = inputs.frozen[0] != MODEL_ALONE
    show_measured(parts.command, x)
    for i in range(n):
        e1, e1d = x_ref[i] - x[i], x_ref[n + i] - x[n + i]
        e2 = e1d + parts.alpha1[i] * e1
        if parts.begun[0] == 0.0:
            nu[i] = -parts.gain[i] * e2
        elif adapting:
            nu[i] += dt * parts.alpha2[i] * (inputs.tau[i] - parts.asked[i])
        tau[i] = parts.gain[i] * e2 + nu[i]
        if adapting:
            sign = 1.0 if e2 > 0.0 else -1.0 if e2 < 0.0 else 0.0
            nu[i] += dt * (parts.gain[i] * parts.alpha2[i] * e2 + parts.beta[i] * sign)
    copy(tau, parts.asked)
    parts.begun[0] = 1.0


run_ticks = closed_loop(update)
