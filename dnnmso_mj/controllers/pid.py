"""PID at each joint, without any model, with back-calculation against windup.

    τ = −K_p e − K_d ė + z
    ż = −K_i e + (τ_acted − τ) / T_t          T_t = √(K_d/K_i)          e = q − q_ref

T_t is the geometric mean of the integral time K_p/K_i and the derivative time K_d/K_p. While the
drive gives what was asked the second term is zero; at a limit z follows what is given, and does not
wind up. The drive tells one period late, so that a period's shortfall enters at the next tick. What
a drive with lag or delay owes for a while counts as a shortfall too, and is paid back as it comes.

Back-calculation and T_t: Åström and Hägglund, "PID Controllers: Theory, Design, and Tuning", ISA,
1995, section 3.5. PID of robots: Arimoto and Miyazaki, "Stability and robustness of PID feedback
control for robot manipulators of sensory capability", Int. Symp. Robotics Research, 1984.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import copy, inner
from dnnmso_mj.controllers import MODEL_ALONE, Command, CompiledTicks, Inputs
from dnnmso_mj.controllers.measured import empty_command, show_measured
from dnnmso_mj.scenario import Pid, expand
from dnnmso_mj.tick import closed_loop

Array = np.ndarray


class Parts(NamedTuple):
    """The controller's arrays."""

    kp: Array  # (n,) N·m/rad
    ki: Array  # (n,) N·m/(rad·s)
    kd: Array  # (n,) N·m·s/rad
    unwind: Array  # 1/T_t (n,) 1/s
    z: Array  # (n,) N·m, the integral
    asked: Array  # (n,) N·m, commanded in the last tick
    command: Command
    dt: float  # s


class PidController:
    """PID of the joint error; while frozen as MODEL_ALONE the integral keeps its value.

    Args:
        spec: gains of the scenario.
        n_joints: n.
        dt: control period (s).
    """

    n_layers = 0

    def __init__(self, spec: Pid, n_joints: int, dt: float) -> None:
        n = n_joints
        ki, kd = expand(spec.ki, n), expand(spec.kd, n)
        self._parts = Parts(
            kp=expand(spec.kp, n),
            ki=ki,
            kd=kd,
            unwind=np.sqrt(ki / kd),
            z=np.zeros(n),
            asked=np.zeros(n),
            command=empty_command(n),
            dt=dt,
        )
        self.ticks = CompiledTicks(run_ticks, self._parts, PidController.update)

    def reset(self, x: Array) -> None:
        self._parts.z[:] = 0.0
        self._parts.asked[:] = 0.0

    def update(self, inputs: Inputs) -> Command:
        update(self._parts, inputs)
        return self._parts.command

    def dynamics(self, x: Array) -> Array:
        return np.zeros(x.size // 2)

    def state(self) -> dict[str, Array]:
        return {"integral": self._parts.z.copy(), "asked": self._parts.asked.copy()}

    def restore(self, state: Mapping[str, Array]) -> None:
        self._parts.z[:] = state["integral"]
        self._parts.asked[:] = state["asked"]


@inner
def update(parts: Parts, inputs: Inputs) -> None:
    """One tick of the law above."""
    x, x_ref, n, dt = inputs.x, inputs.x_ref, parts.z.size, parts.dt
    tau = parts.command.tau
    adapting = inputs.frozen[0] != MODEL_ALONE
    show_measured(parts.command, x)
    for i in range(n):
        e, ed = x[i] - x_ref[i], x[n + i] - x_ref[n + i]
        if adapting:
            parts.z[i] += dt * parts.unwind[i] * (inputs.tau[i] - parts.asked[i])
        tau[i] = -parts.kp[i] * e - parts.kd[i] * ed + parts.z[i]
        if adapting:
            parts.z[i] -= dt * parts.ki[i] * e
    copy(tau, parts.asked)


run_ticks = closed_loop(update)
