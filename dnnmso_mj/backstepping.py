"""A command filtered backstepping law for a learned model, of two steps or three.

    ẋ₁ = x₂ + d₁(x),   ẋ₂ = f₂(x) + B₂ τ,   T τ̇ = τ_cmd − τ

    α₁ = q̇_ref − K_q e₁ − d̂₁                            e₁ = x₁ − q_ref
    α₂ = B₂⁻¹ (v̇_c − f̂₂ − K_v z₂ − w₁)                  z₂ = x₂ − v_c,   v_c: α₁ filtered
    τ_cmd = τ + T (τ̇_c − B₂ᵀ w₂ − K_τ z₃)               z₃ = τ − τ_c,    τ_c: α₂ filtered

    w₁ = e₁ − ξ₁,   ξ̇₁ = −K_q ξ₁ + ξ₂ + v_c − α₁
    w₂ = z₂ − ξ₂,   ξ̇₂ = −K_v ξ₂ + B₂ (τ_c − α₂)

Without a lag the law ends with τ = α₂, and ξ₂ = 0. It takes f̂ + K₂ e_a for f: the network's f̂,
and what the observer's error says is missing in it. The derivation, V̇ ≤ −κ‖w‖² + ε‖w‖, and what
sampling does to it are in docs/backstepping.md.

Source: Farrell, Polycarpou, Sharma, Dong, "Command filtered backstepping", IEEE Transactions on
Automatic Control 54(6), 2009.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dnnmso_mj.command_filter import CommandFilter, build_filter, follow, start_filter
from dnnmso_mj.compiling import copy, inner
from dnnmso_mj.inversion import solve_spd
from dnnmso_mj.observer import StateObserver, advance, build_observer, compare
from dnnmso_mj.plant import Nominal, inertia
from dnnmso_mj.scenario import Backstepping, Constant, expand

if TYPE_CHECKING:
    from dnnmso_mj.controllers import Inputs

Array = np.ndarray


class Errors(NamedTuple):
    """The errors of the steps, of the last tick."""

    w1: Array  # (n,) rad, compensated
    w2: Array  # (n,) rad/s, compensated
    z3: Array  # (n,) N·m; zero in two steps
    xi1: Array  # (n,) rad, the compensation of this tick, and
    xi2: Array  # (n,) rad/s
    xi1_next: Array  # of the next
    xi2_next: Array


class Law(NamedTuple):
    """The arrays of the law; without the network."""

    observer: StateObserver
    tau: Array  # (n,) N·m, the command
    Bu: Array  # B τ (2n,)
    f_hat: Array  # f̂ (2n,)
    errors: Errors
    velocity: CommandFilter  # v_c
    torque: CommandFilter  # τ_c
    drift: Array  # (2n,) what the law takes for f: f̂ + K₂ e_a
    gains: Array  # (3, n) K_q, K_v and K_τ (1/s)
    B2_inv: Array  # (n, n) of the last tick
    push: Array  # (n,) scratch
    change: Array  # (n,) scratch
    L: Array  # (n, n) scratch
    fresh: Array  # (1,) int64: whether no tick was before
    nominal: Nominal
    constant: bool  # B₂ = b·I
    feedforward: bool
    lag: float  # s, see `build_law`; zero where two steps are all


def build_law(spec: Backstepping, n: int, dt: float, nominal: Nominal) -> Law:
    """The law of a scenario for n joints.

    N.B. the drives report the mean torque of the period before, half a period old, and what is
    commanded acts half a period later in the mean: a change by the rate asked for takes T + dt.
    """
    observer = build_observer(spec.observer, 2 * n, dt)
    tau, push, change = np.zeros((3, n))
    Bu, f_hat, drift = np.zeros((3, 2 * n))
    b = spec.effectiveness.b if isinstance(spec.effectiveness, Constant) else 1.0
    return Law(
        observer=observer,
        tau=tau,
        Bu=Bu,
        f_hat=f_hat,
        errors=Errors(*np.zeros((7, n))),
        velocity=build_filter(spec.filter_v, n, dt, ahead=False),
        torque=build_filter(spec.filter_tau, n, dt, ahead=True),
        drift=drift,
        gains=np.array([expand(gain, n) for gain in (spec.K_q, spec.K_v, spec.K_tau)]),
        B2_inv=np.eye(n) / b,
        push=push,
        change=change,
        L=np.zeros((n, n)),
        fresh=np.ones(1, np.int64),
        nominal=nominal,
        constant=isinstance(spec.effectiveness, Constant),
        feedforward=spec.feedforward,
        lag=0.0 if spec.actuator_lag is None else spec.actuator_lag + dt,
    )


def held(law: Law) -> dict[str, Array]:
    """What the law keeps from one tick to the next, by name."""
    return {
        "x_hat": law.observer.x_hat,
        "e_obs": law.observer.e_obs,
        "f_hat": law.f_hat,
        "tau": law.tau,
        "B2_inv": law.B2_inv,
        "velocity_command": law.velocity.value,
        "velocity_slope": law.velocity.slope,
        "torque_command": law.torque.value,
        "torque_slope": law.torque.slope,
        "xi1": law.errors.xi1_next,
        "xi2": law.errors.xi2_next,
        "fresh": law.fresh,
    }


@inner
def observe(law: Law, inputs: Inputs) -> None:
    """Bring X̂ to this tick with the torque that acted; f̂ = [x₂; 0], what no network is asked."""
    x, n = inputs.x, inputs.tau.size
    if law.fresh[0] == 0:
        for i in range(n):
            law.push[i] = inputs.tau[i] if law.observer.applied else law.tau[i]
            law.Bu[i] = 0.0
        solve_spd(law.B2_inv, law.push, law.Bu[n:], law.L)
        advance(law.observer, law.f_hat, law.Bu)
    compare(law.observer, x)
    if not law.constant:
        inertia(law.nominal, x[:n])
        for i in range(n):
            copy(law.nominal.M[i], law.B2_inv[i])
    for i in range(n):
        law.f_hat[i], law.f_hat[n + i] = x[n + i], 0.0


@inner
def act(law: Law, inputs: Inputs, corrected: bool) -> None:
    """The steps of the law, once f̂ is complete; `corrected`: K₂ e_a may be added to it."""
    observer, n = law.observer, law.tau.size
    weight = 1.0 if corrected and law.feedforward else 0.0
    for i in range(law.drift.size):
        law.drift[i] = law.f_hat[i] + weight * observer.gain[i] * observer.e_obs[i]
    if law.fresh[0] == 1:
        for i in range(n):
            law.errors.xi1_next[i] = law.errors.xi2_next[i] = 0.0
    command_velocity(law, inputs)
    command_torque(law)
    if law.lag > 0.0:
        lead_the_drives(law, inputs)
    solve_spd(law.B2_inv, law.tau, law.Bu[n:], law.L)
    law.fresh[0] = 0


@inner
def command_velocity(law: Law, inputs: Inputs) -> None:
    """Step 1: α₁ and v_c, and the compensated errors w₁ and w₂ of this tick."""
    x, errors, n = inputs.x, law.errors, inputs.tau.size
    for i in range(n):
        K_q, e1 = law.gains[0, i], x[i] - inputs.x_ref[i]
        errors.xi1[i], errors.xi2[i] = errors.xi1_next[i], errors.xi2_next[i]
        alpha = inputs.xd_ref[i] - K_q * e1 - (law.drift[i] - x[n + i])
        known = inputs.xd_ref[n + i] - K_q * (law.drift[i] - inputs.xd_ref[i])
        if law.fresh[0] == 1:
            start_filter(law.velocity, i, alpha)
        v_c = law.velocity.value[i]
        errors.w1[i] = e1 - errors.xi1[i]
        errors.w2[i] = x[n + i] - v_c - errors.xi2[i]
        compensation = -K_q * errors.xi1[i] + errors.xi2[i] + v_c - alpha
        errors.xi1_next[i] += law.observer.dt * compensation
        follow(law.velocity, i, alpha, known)


@inner
def command_torque(law: Law) -> None:
    """Step 2: τ = α₂."""
    tau, errors, n = law.tau, law.errors, law.push.size
    for i in range(n):
        z2 = errors.w2[i] + errors.xi2[i]
        law.push[i] = law.velocity.rate[i] - law.drift[n + i]
        law.push[i] -= law.gains[1, i] * z2 + errors.w1[i]
    for i in range(n):
        tau[i] = 0.0
        for j in range(n):
            tau[i] += law.B2_inv[i, j] * law.push[j]


@inner
def lead_the_drives(law: Law, inputs: Inputs) -> None:
    """Step 3: what makes drives of a lag give α₂, in the place of it."""
    tau, errors, torque, n = law.tau, law.errors, law.torque, law.push.size
    for i in range(n):
        if law.fresh[0] == 1:
            start_filter(torque, i, tau[i])
        errors.z3[i] = inputs.tau[i] - torque.value[i]
        follow(torque, i, tau[i], 0.0)
        law.push[i] = torque.value[i] - tau[i]
    solve_spd(law.B2_inv, law.push, law.change, law.L)  # B₂ (τ_c − α₂)
    for i in range(n):
        compensation = -law.gains[1, i] * errors.xi2[i] + law.change[i]
        errors.xi2_next[i] += law.observer.dt * compensation
    solve_spd(law.B2_inv, errors.w2, law.change, law.L)  # B₂ is symmetric
    for i in range(n):
        rate = torque.rate[i] - law.change[i] - law.gains[2, i] * errors.z3[i]
        tau[i] = inputs.tau[i] + law.lag * rate
