"""The classical modified state observer with radial basis functions, tuned by a gradient law.

    d̂(X) = Ŵᵀ φ(X),   φ_j = exp(−½ Σ_i ((X_i − c_ji)/s_i)²)
    Ŵ'   = Γ (φ (B₂ᵀ e_a)ᵀ − κ ‖e_a‖ Ŵ)        (e_a in B₂ᵀ e_a: its lower n rows)

Observer and inversion are those of `classical_mso`; here the uncertainty is linear in its weights,
as in the works that the paper builds on, and e-modification keeps them bounded without excitation.
The centres c_j are drawn over a box of states; outside it the network has nothing to say.

Sources: Padhi, Unnikrishnan, Balakrishnan, "Model-following neuro-adaptive control design for
non-square, non-affine nonlinear systems", IET Control Theory Appl. 1(6), 2007; Rajagopal et al.,
AIAA Guidance, Navigation, and Control Conf., 2009 (both: the modified state observer); Sanner,
Slotine, "Gaussian networks for direct adaptive control", IEEE Trans. Neural Networks 3(6), 1992;
Narendra, Annaswamy, "A new adaptive law for robust adaptation without persistent excitation", IEEE
Trans. Automatic Control 32(2), 1987 (e-modification).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import compiled, inner
from dnnmso_mj.controllers import LEARNING, Command, CompiledTicks, Inputs, command_of
from dnnmso_mj.controllers.classical_mso import Law, build_law, command_with, drift
from dnnmso_mj.monitors import Monitors
from dnnmso_mj.observer import begin, held, hold
from dnnmso_mj.plant import NominalModel
from dnnmso_mj.scenario import RbfMso, expand
from dnnmso_mj.tick import closed_loop

Array = np.ndarray


class Rbf(NamedTuple):
    """Radial basis functions, N of them, and their weights."""

    W: Array  # Ŵ (N, n)
    centres: Array  # c (N, 2n), rad and rad/s
    width: Array  # s (2n,)
    phi: Array  # φ (N,)
    d_hat: Array  # (n,) N·m
    rate: float  # Γ dt
    kappa: float


class Parts(NamedTuple):
    """The arrays of the compiled controller."""

    law: Law
    command: Command
    rbf: Rbf


class RbfMsoController:
    """MSO with known dynamics and a matched uncertainty of radial basis functions.

    Args:
        spec: gains and basis of the scenario.
        n_joints: n.
        dt: control period (s).
        seed: of the centres.
        nominal: the controller's own model of the robot, read for f and B.
    """

    n_layers = 0

    def __init__(
        self, spec: RbfMso, n_joints: int, dt: float, seed: int, nominal: NominalModel
    ) -> None:
        self._nominal = nominal  # keeps alive what compiled code knows by address
        law = build_law(spec.inversion, spec.observer, n_joints, dt, nominal)
        command = command_of(law.inversion, law.observer.e_obs, Monitors.zeros(0))
        self._parts = Parts(law, command, build_rbf(spec, n_joints, dt, seed))
        self.ticks = CompiledTicks(run_ticks, self._parts, RbfMsoController.update)

    def reset(self, x: Array) -> None:
        begin(self._parts.law.observer, self._parts.law.inversion, x)

    def update(self, inputs: Inputs) -> Command:
        update(self._parts, inputs)
        return self._parts.command

    def dynamics(self, x: Array) -> Array:
        respond(self._parts.rbf, x)
        return drift(self._parts.law, x, self._parts.rbf.d_hat)

    def state(self) -> dict[str, Array]:
        law, rbf = self._parts.law, self._parts.rbf
        kept = held(law.observer, law.inversion)
        return {**kept, "W": rbf.W.copy(), "centres": rbf.centres.copy()}

    def restore(self, state: Mapping[str, Array]) -> None:
        hold(self._parts.law.observer, self._parts.law.inversion, state)
        self._parts.rbf.W[:] = state["W"]
        self._parts.rbf.centres[:] = state["centres"]


def build_rbf(spec: RbfMso, n_joints: int, dt: float, seed: int) -> Rbf:
    """The basis of a scenario, with weights of zero."""
    n = n_joints
    box = expand(spec.box, 2 * n)
    centres = np.random.default_rng(seed).uniform(-box, box, size=(spec.centres, 2 * n))
    return Rbf(
        W=np.zeros((spec.centres, n)),
        centres=centres,
        width=spec.width * box,
        phi=np.zeros(spec.centres),
        d_hat=np.zeros(n),
        rate=spec.Gamma * dt,
        kappa=spec.kappa,
    )


@compiled
def respond(rbf: Rbf, x: Array) -> None:
    """φ(x) and d̂(x) for x (2n,)."""
    for i in range(rbf.d_hat.size):
        rbf.d_hat[i] = 0.0
    for j in range(rbf.phi.size):
        distance = 0.0
        for i in range(x.size):
            distance += ((x[i] - rbf.centres[j, i]) / rbf.width[i]) ** 2
        rbf.phi[j] = math.exp(-0.5 * distance)
        for i in range(rbf.d_hat.size):
            rbf.d_hat[i] += rbf.W[j, i] * rbf.phi[j]


@compiled
def adapt(rbf: Rbf, delta: Array, e_obs: Array) -> None:
    """One period of the weights' law for delta = −B₂ᵀ e_a (n,) and e_a (2n,)."""
    square = 0.0
    for i in range(e_obs.size):
        square += e_obs[i] ** 2
    forget = rbf.kappa * math.sqrt(square)
    for j in range(rbf.phi.size):
        for i in range(delta.size):
            rbf.W[j, i] -= rbf.rate * (rbf.phi[j] * delta[i] + forget * rbf.W[j, i])


@inner
def update(parts: Parts, inputs: Inputs) -> None:
    """One tick of the law above."""
    law, rbf = parts.law, parts.rbf
    respond(rbf, inputs.x)
    command_with(law, parts.command, rbf.d_hat, inputs)
    if inputs.frozen[0] == LEARNING:
        adapt(rbf, law.delta, law.observer.e_obs)


run_ticks = closed_loop(update)
