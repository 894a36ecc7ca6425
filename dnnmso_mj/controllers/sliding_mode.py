"""Sliding mode control with a boundary layer.

    s = ė + λ e                                   e = q − q_ref
    τ = B₂⁻¹ (q̈_ref − λ ė − k sat(s/φ))

With the true B₂ each joint has ṡ = f₂ − k sat(s/φ). So if |f₂| ≤ F < k, |s| ≤ φ is reached within
(|s(0)| − φ)/(k − F) and never left, |s| then settles within φ F/k, and |e| within φ F/(k λ). The
drift f₂ = −M⁻¹(V + G) is all taken for disturbance.

Slotine and Li, "Applied Nonlinear Control", Prentice Hall, 1991, sections 7.1 and 7.2.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import inner
from dnnmso_mj.controllers import Command, CompiledTicks, Inputs
from dnnmso_mj.controllers.measured import empty_command, show_measured
from dnnmso_mj.effectiveness import Effectiveness, build_effectiveness, evaluate, torque_for
from dnnmso_mj.plant import NominalModel
from dnnmso_mj.scenario import SlidingMode, expand
from dnnmso_mj.tick import closed_loop

Array = np.ndarray


class Parts(NamedTuple):
    """The controller's arrays."""

    lam: Array  # (n,) 1/s
    gain: Array  # k (n,) rad/s²
    layer: Array  # φ (n,) rad/s
    wanted: Array  # (n,) rad/s²
    effectiveness: Effectiveness
    command: Command


class SlidingModeController:
    """Smoothed sliding mode control.

    Args:
        spec: gains of the scenario.
        n_joints: n.
        nominal: the controller's own model of the robot, read for B₂ alone.
    """

    n_layers = 0

    def __init__(self, spec: SlidingMode, n_joints: int, nominal: NominalModel) -> None:
        n = n_joints
        self._nominal = nominal  # keeps alive what compiled code knows by address
        self._parts = Parts(
            lam=expand(spec.lam, n),
            gain=expand(spec.gain, n),
            layer=expand(spec.boundary_layer, n),
            wanted=np.zeros(n),
            effectiveness=build_effectiveness(spec.effectiveness, n, nominal.view),
            command=empty_command(n),
        )
        self.ticks = CompiledTicks(run_ticks, self._parts, SlidingModeController.update)

    def reset(self, x: Array) -> None:
        """The law has no memory."""

    def update(self, inputs: Inputs) -> Command:
        update(self._parts, inputs)
        return self._parts.command

    def dynamics(self, x: Array) -> Array:
        return np.zeros(x.size // 2)

    def state(self) -> dict[str, Array]:
        return {}

    def restore(self, state: Mapping[str, Array]) -> None:
        """The law has no memory."""


@inner
def update(parts: Parts, inputs: Inputs) -> None:
    """One tick of the law above."""
    x, x_ref, n = inputs.x, inputs.x_ref, parts.lam.size
    show_measured(parts.command, x)
    evaluate(parts.effectiveness, x[:n])
    for i in range(n):
        e, ed = x[i] - x_ref[i], x[n + i] - x_ref[n + i]
        s = ed + parts.lam[i] * e
        smooth = max(-1.0, min(1.0, s / parts.layer[i]))
        parts.wanted[i] = inputs.xd_ref[n + i] - parts.lam[i] * ed - parts.gain[i] * smooth
    torque_for(parts.effectiveness, parts.wanted, parts.command.tau)


run_ticks = closed_loop(update)
