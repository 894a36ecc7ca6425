"""The two-layer neural-net controller of Lewis, Yesildirek and Liu, which needs no model.

    e = q_ref − q,   r = ė + λ e,   y = [e; ė; q_ref; q̇_ref; q̈_ref; 1]
    τ  = Ŵᵀ σ(V̂ᵀ y) + K_v r − v,   v = −K_Z (‖Ẑ‖ + Z_B) r
    Ŵ' = F (σ̂ − σ̂' V̂ᵀ y) rᵀ − κ F ‖r‖ Ŵ
    V̂' = G y (σ̂'ᵀ Ŵ r)ᵀ − κ G ‖r‖ V̂

The network stands for M(q)(q̈_ref + λ ė) + V(q, q̇_ref + λ e) + G(q). σ is the sigmoid with a
constant 1 beside it, for thresholds of the output, and ‖Ẑ‖ the Frobenius norm of all weights. The
correction of backpropagation, σ̂' V̂ᵀ y, and the forgetting in proportion to ‖r‖ bound r and the
weights without excitation (proved there for weights in continuous time; here they take an Euler
step a tick).

N.B. Ŵ starts at zero, as published, and V̂ at random: at zero the hidden units would stay alike.

Source: Lewis, Yesildirek, Liu, "Multilayer neural-net robot controller with guaranteed tracking
performance", IEEE Trans. Neural Networks 7(2), 1996.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import compiled, copy, inner
from dnnmso_mj.controllers import LEARNING, Command, CompiledTicks, Inputs
from dnnmso_mj.inversion import solve_spd
from dnnmso_mj.monitors import Monitors
from dnnmso_mj.plant import Nominal, NominalModel, inertia
from dnnmso_mj.scenario import LewisNn, expand
from dnnmso_mj.tick import closed_loop

Array = np.ndarray


class Law(NamedTuple):
    """The arrays of the network and its tuning; H hidden units, m = 5n + 1 inputs."""

    V: Array  # V̂ (m, H)
    W: Array  # Ŵ (H + 1, n), the constant's row last
    y: Array  # (m,)
    z: Array  # V̂ᵀ y (H,)
    hidden: Array  # σ̂ (H + 1,)
    back: Array  # σ̂'ᵀ Ŵ r (H,)
    out: Array  # Ŵᵀ σ̂ (n,) N·m
    r: Array  # (n,) rad/s
    K_v: Array  # (n,) N·m·s/rad
    rates: Array  # F dt, G dt, κ
    robust: Array  # K_Z, Z_B
    lam: float  # 1/s


class Parts(NamedTuple):
    """The controller's arrays."""

    law: Law
    command: Command
    nominal: Nominal  # read for M in what is shown of the learned dynamics, never for torque
    L: Array  # (n, n) scratch


class LewisNnController:
    """Filtered-error control with a two-layer network.

    Args:
        spec: gains and rates of the scenario.
        n_joints: n.
        dt: control period (s).
        seed: of the first hidden weights.
        nominal: for M of `dynamics` alone, since the network learns forces, not accelerations.
    """

    n_layers = 0

    def __init__(
        self, spec: LewisNn, n_joints: int, dt: float, seed: int, nominal: NominalModel
    ) -> None:
        n = n_joints
        self._nominal = nominal  # keeps alive what compiled code knows by address
        Bu, x_hat, f_hat, e_obs = np.zeros((4, 2 * n))
        command = Command(np.zeros(n), Bu, x_hat, f_hat, e_obs, Monitors.zeros(0))
        law = build_law(spec, n, dt, seed)
        self._parts = Parts(law, command, nominal.view, np.zeros((n, n)))
        self.ticks = CompiledTicks(run_ticks, self._parts, LewisNnController.update)

    def reset(self, x: Array) -> None:
        """Nothing depends on the state before the first tick."""

    def update(self, inputs: Inputs) -> Command:
        update(self._parts, inputs)
        return self._parts.command

    def dynamics(self, x: Array) -> Array:
        out = np.zeros(x.size)
        _drift(self._parts, x, out)
        return out[x.size // 2 :]

    def state(self) -> dict[str, Array]:
        return {"V": self._parts.law.V.copy(), "W": self._parts.law.W.copy()}

    def restore(self, state: Mapping[str, Array]) -> None:
        self._parts.law.V[:] = state["V"]
        self._parts.law.W[:] = state["W"]


def build_law(spec: LewisNn, n_joints: int, dt: float, seed: int) -> Law:
    """The law of a scenario at its first weights."""
    n, n_in = n_joints, 5 * n_joints + 1
    spread = spec.init_scale / math.sqrt(n_in)
    z, back = np.zeros((2, spec.hidden))
    out, r = np.zeros((2, n))
    return Law(
        V=np.random.default_rng(seed).normal(0.0, spread, size=(n_in, spec.hidden)),
        W=np.zeros((spec.hidden + 1, n)),
        y=np.zeros(n_in),
        z=z,
        hidden=np.ones(spec.hidden + 1),
        back=back,
        out=out,
        r=r,
        K_v=expand(spec.K_v, n),
        rates=np.array([spec.F * dt, spec.G * dt, spec.kappa]),
        robust=np.array([spec.K_Z, spec.Z_B]),
        lam=spec.lam,
    )


@compiled
def respond(law: Law) -> None:
    """Ŵᵀ σ(V̂ᵀ y) for the y at hand."""
    for j in range(law.z.size):
        z = 0.0
        for k in range(law.y.size):
            z += law.V[k, j] * law.y[k]
        law.z[j] = z
        law.hidden[j] = 1.0 / (1.0 + math.exp(-z))
    for i in range(law.out.size):
        law.out[i] = 0.0
        for j in range(law.hidden.size):
            law.out[i] += law.W[j, i] * law.hidden[j]


@compiled
def track(law: Law, x: Array, x_ref: Array, xd_ref: Array, tau: Array) -> None:
    """τ (n,) with the present weights; leaves r and the network's activations for `tune`."""
    n = tau.size
    for i in range(n):
        e, ed = x_ref[i] - x[i], x_ref[n + i] - x[n + i]
        law.r[i] = ed + law.lam * e
        law.y[i], law.y[n + i] = e, ed
        law.y[2 * n + i], law.y[3 * n + i] = x_ref[i], x_ref[n + i]
        law.y[4 * n + i] = xd_ref[n + i]
    law.y[5 * n] = 1.0
    respond(law)
    robust = law.robust[0] * (math.sqrt(_squares(law.V) + _squares(law.W)) + law.robust[1])
    for i in range(n):
        tau[i] = law.out[i] + (law.K_v[i] + robust) * law.r[i]


@compiled
def _squares(A: Array) -> float:
    total = 0.0
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            total += A[i, j] * A[i, j]
    return total


@compiled
def tune(law: Law) -> None:
    """One period of the weights' laws, both from the weights before it."""
    F, G, kappa = law.rates
    n, n_hidden = law.r.size, law.z.size
    square = 0.0
    for i in range(n):
        square += law.r[i] ** 2
    forget = kappa * math.sqrt(square)
    for j in range(n_hidden + 1):
        corrected = law.hidden[j]
        if j < n_hidden:
            slope = law.hidden[j] * (1.0 - law.hidden[j])
            corrected -= slope * law.z[j]
            law.back[j] = 0.0
            for i in range(n):
                law.back[j] += slope * law.W[j, i] * law.r[i]
        for i in range(n):
            law.W[j, i] += F * (corrected * law.r[i] - forget * law.W[j, i])
    for k in range(law.y.size):
        for j in range(n_hidden):
            law.V[k, j] += G * (law.y[k] * law.back[j] - forget * law.V[k, j])


@inner
def _drift(parts: Parts, x: Array, out: Array) -> None:
    """[q̇; −M⁻¹ N̂] (2n,): N̂ is the torque that the network gives for tracking x without error."""
    law, n = parts.law, x.size // 2
    for i in range(2 * n):
        law.y[i], law.y[2 * n + i] = 0.0, x[i]
    for i in range(n):
        law.y[4 * n + i] = 0.0
    law.y[5 * n] = 1.0
    respond(law)
    inertia(parts.nominal, x[:n])
    solve_spd(parts.nominal.M, law.out, law.r, parts.L)
    for i in range(n):
        out[i], out[n + i] = x[n + i], -law.r[i]


@inner
def update(parts: Parts, inputs: Inputs) -> None:
    """One tick of the law above."""
    law, command = parts.law, parts.command
    copy(inputs.x, command.x_hat)
    _drift(parts, inputs.x, command.f_hat)
    track(law, inputs.x, inputs.x_ref, inputs.xd_ref, command.tau)
    if inputs.frozen[0] == LEARNING:
        tune(law)


run_ticks = closed_loop(update)
