"""L1 adaptive control: piecewise-constant adaptation, and a filter that keeps it slow enough.

The plant is q̈ = B₂ τ + σ(t), σ lumping all that is unknown; the law has four parts:

    baseline     τ = B₂⁻¹ (q̈_ref − K_d ė − K_p e + u)          e = q − q_ref
    predictor    v̂' = B₂ τ_acted + σ̂ − a ṽ,   ṽ = v̂ − q̇
    adaptation   σ̂ = −Φ⁻¹ exp(−a dt) ṽ at each tick,   Φ = (1 − exp(−a dt))/a
    filter       u' = −ω_f (u + σ̂)

The adaptation is as fast as sampling allows: one period later ṽ = −Φ σ̄, with σ̄ the mean of σ over
that period, so |ṽ| ≤ dt max|σ| whatever the plant does, and σ̂ = exp(−a dt) σ̄. The filter decides
what is compensated: u follows −σ̂ within 1/ω_f, and a share a dt of a constant σ is left. The
predictor is integrated over a period in closed form, q̈ being taken for constant in it; all is in
acceleration, the matched channel of a robot with inertia B₂⁻¹.

Hovakimyan and Cao, "L1 Adaptive Control Theory: Guaranteed Robustness with Fast Adaptation", SIAM,
2010, section 3.3. Xargay, Hovakimyan and Cao, "L1 adaptive controller for multi-input multi-output
systems in the presence of nonlinear unmatched uncertainties", American Control Conference, 2010.
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
from dnnmso_mj.scenario import L1, expand
from dnnmso_mj.tick import closed_loop

Array = np.ndarray


class Predictor(NamedTuple):
    """The predictor and what it has found, at the control period."""

    v_err: Array  # ṽ (n,) rad/s
    sigma: Array  # σ̂ (n,) rad/s²
    u: Array  # (n,) rad/s²
    qd: Array  # (n,) rad/s, read at the last tick
    decay: Array  # exp(−a dt) (n,)
    phi: Array  # Φ (n,) s
    passing: Array  # 1 − exp(−ω_f dt) (n,)
    effect: Array  # B₂ τ_acted (n,) rad/s²
    dt: float  # s


class Parts(NamedTuple):
    """The controller's arrays."""

    predictor: Predictor
    kp: Array  # (n,) 1/s²
    kd: Array  # (n,) 1/s
    wanted: Array  # (n,) rad/s²
    effectiveness: Effectiveness
    command: Command


MEMORY = ("v_err", "sigma", "u", "qd")


def build_predictor(spec: L1, n: int, dt: float) -> Predictor:
    """The predictor of a scenario for n joints and period dt (s), with an empty memory."""
    a = expand(spec.predictor_gain, n)
    v_err, sigma, u, qd, effect = np.zeros((5, n))
    return Predictor(
        v_err=v_err,
        sigma=sigma,
        u=u,
        qd=qd,
        decay=np.exp(-a * dt),
        phi=-np.expm1(-a * dt) / a,
        passing=-np.expm1(-expand(spec.filter_bandwidth, n) * dt),
        effect=effect,
        dt=dt,
    )


class L1Controller:
    """L1 adaptive control; while frozen as MODEL_ALONE nothing is compensated.

    Args:
        spec: gains of the scenario.
        n_joints: n.
        dt: control period (s).
        nominal: the controller's own model of the robot, read for B₂ alone.
    """

    n_layers = 0

    def __init__(self, spec: L1, n_joints: int, dt: float, nominal: NominalModel) -> None:
        n = n_joints
        self._nominal = nominal  # keeps alive what compiled code knows by address
        self._parts = Parts(
            predictor=build_predictor(spec, n, dt),
            kp=expand(spec.kp, n),
            kd=expand(spec.kd, n),
            wanted=np.zeros(n),
            effectiveness=build_effectiveness(spec.effectiveness, n, nominal.view),
            command=empty_command(n),
        )
        self.ticks = CompiledTicks(run_ticks, self._parts, L1Controller.update)

    def reset(self, x: Array) -> None:
        predictor = self._parts.predictor
        for memory in (predictor.v_err, predictor.sigma, predictor.u):
            memory[:] = 0.0
        predictor.qd[:] = x[x.size // 2 :]

    def update(self, inputs: Inputs) -> Command:
        update(self._parts, inputs)
        return self._parts.command

    def dynamics(self, x: Array) -> Array:
        return np.zeros(x.size // 2)

    def state(self) -> dict[str, Array]:
        predictor = self._parts.predictor
        return {name: getattr(predictor, name).copy() for name in MEMORY}

    def restore(self, state: Mapping[str, Array]) -> None:
        for name in MEMORY:
            getattr(self._parts.predictor, name)[:] = state[name]


@inner
def predict(predictor: Predictor, effect: Array, qd: Array) -> None:
    """ṽ (n,) at the reading qd (n,) rad/s, a period after the last, under B₂ τ_acted = `effect`."""
    v_err, phi = predictor.v_err, predictor.phi
    for i in range(qd.size):
        qdd = (qd[i] - predictor.qd[i]) / predictor.dt
        pushed = phi[i] * (predictor.sigma[i] + effect[i] - qdd)
        v_err[i] = predictor.decay[i] * v_err[i] + pushed
        predictor.qd[i] = qd[i]


@inner
def adapt(predictor: Predictor) -> None:
    """σ̂ from ṽ, and what of it passes the filter."""
    for i in range(predictor.u.size):
        predictor.sigma[i] = -predictor.decay[i] * predictor.v_err[i] / predictor.phi[i]
        predictor.u[i] -= predictor.passing[i] * (predictor.u[i] + predictor.sigma[i])


@inner
def update(parts: Parts, inputs: Inputs) -> None:
    """One tick of the law above."""
    predictor, command, effectiveness = parts.predictor, parts.command, parts.effectiveness
    x, x_ref, n = inputs.x, inputs.x_ref, parts.wanted.size
    evaluate(effectiveness, x[:n])
    # At the first tick no period has passed and no torque acted: ṽ stays zero.
    acceleration_of(effectiveness, inputs.tau, predictor.effect)
    predict(predictor, predictor.effect, x[n:])
    adapt(predictor)
    for i in range(n):
        known = predictor.u[i] if inputs.frozen[0] != MODEL_ALONE else 0.0
        e, ed = x[i] - x_ref[i], x[n + i] - x_ref[n + i]
        parts.wanted[i] = inputs.xd_ref[n + i] - parts.kd[i] * ed - parts.kp[i] * e + known
        command.x_hat[i], command.x_hat[n + i] = x[i], x[n + i] + predictor.v_err[i]
        command.e_obs[i], command.e_obs[n + i] = 0.0, -predictor.v_err[i]
        command.f_hat[i], command.f_hat[n + i] = x[n + i], -known
    torque_for(effectiveness, parts.wanted, command.tau)


run_ticks = closed_loop(update)
