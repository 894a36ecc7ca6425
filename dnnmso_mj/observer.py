"""The state observer whose error trains the network.

    X̂̇ = f̂ + B u + K₂ (X − X̂)      ⇒      ė_a = f̃ − K₂ e_a,   e_a = X − X̂

N.B. the paper's Eq. 5 prints −K₂ (X − X̂), which makes ė_a = f̃ + K₂ e_a: unstable for K₂ > 0. The
printed sign is kept as an option so that anyone can see it diverge.
The classical MSO (Eq. 4) is the same observer with f̂ = f(X̂) + B d̂.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import compiled, copy, inner
from dnnmso_mj.inversion import DynamicInversion, solve_spd
from dnnmso_mj.scenario import Observer as ObserverSpec
from dnnmso_mj.scenario import expand

Array = np.ndarray


class StateObserver(NamedTuple):
    """The observer at the control period: explicit Euler, since f̂, u and X are held in it."""

    x_hat: Array  # X̂ (2n,)
    e_obs: Array  # e_a (2n,) of the last `compare`
    gain: Array  # K₂ (2n,) with the sign of its feedback
    dt: float  # s
    applied: bool  # whether it hears of the torque that acted, or takes its command for that
    free: Array  # (n,) scratch
    change: Array  # (n,) scratch
    L: Array  # (n, n) scratch


def build_observer(spec: ObserverSpec, n_states: int, dt: float) -> StateObserver:
    """The observer of a scenario for 2n states and control period dt (s)."""
    sign = 1.0 if spec.feedback == "stable" else -1.0
    gain = sign * expand(spec.K2, n_states)
    n = n_states // 2
    return StateObserver(
        x_hat=np.zeros(n_states),
        e_obs=np.zeros(n_states),
        gain=gain,
        dt=dt,
        applied=spec.torque == "applied",
        free=np.zeros(n),
        change=np.zeros(n),
        L=np.zeros((n, n)),
    )


@compiled
def start(observer: StateObserver, x: Array) -> None:
    """Start at the measured state x (2n,): X̂₀ = X₀ (the paper's simulation section)."""
    copy(x, observer.x_hat)


def begin(observer: StateObserver, inversion: DynamicInversion, x: Array) -> None:
    """Start at the measured state x (2n,), with no torque commanded before."""
    start(observer, x)
    inversion.tau[:] = 0.0
    if not inversion.constant:
        inversion.B2_inv[:] = np.eye(inversion.tau.size)


def held(observer: StateObserver, inversion: DynamicInversion) -> dict[str, Array]:
    """What the two keep from one tick to the next, as arrays of a controller's state."""
    kept = {"x_hat": observer.x_hat, "tau": inversion.tau, "B2_inv": inversion.B2_inv}
    return {name: array.copy() for name, array in kept.items()}


def hold(observer: StateObserver, inversion: DynamicInversion, state: Mapping[str, Array]) -> None:
    """Put back what `held` gave."""
    observer.x_hat[:] = state["x_hat"]
    inversion.tau[:], inversion.B2_inv[:] = state["tau"], state["B2_inv"]


@inner
def correct(observer: StateObserver, inversion: DynamicInversion, tau: Array) -> None:
    """Put the torque that acted in the last period in the place of the one commanded for it.

    X̂ ← X̂ + dt B (τ − u) for τ (n,) N·m as the drives report it, and B of the last command. Without
    this a saturated actuator looks like dynamics to learn (windup).
    """
    n = tau.size
    if not observer.applied:
        return
    for i in range(n):
        observer.free[i] = tau[i] - inversion.tau[i]
    solve_spd(inversion.B2_inv, observer.free, observer.change, observer.L)
    for i in range(n):
        observer.x_hat[n + i] += observer.dt * observer.change[i]


@inner
def compare(observer: StateObserver, x: Array) -> None:
    """e_a = X − X̂ for the measured state x (2n,)."""
    for i in range(x.size):
        observer.e_obs[i] = x[i] - observer.x_hat[i]


@inner
def advance(observer: StateObserver, f_hat: Array, Bu: Array) -> None:
    """Integrate X̂ over one period with f̂ (2n,), B u (2n,) and the last e_a."""
    for i in range(f_hat.size):
        rate = f_hat[i] + Bu[i] + observer.gain[i] * observer.e_obs[i]
        observer.x_hat[i] += observer.dt * rate
