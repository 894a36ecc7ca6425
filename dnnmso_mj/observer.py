"""The state observer whose error trains the network.

    X̂̇ = f̂ + B u + K₂ (X − X̂)      ⇒      ė_a = f̃ − K₂ e_a,   e_a = X − X̂

N.B. the paper's Eq. 5 prints −K₂ (X − X̂), which makes ė_a = f̃ + K₂ e_a: unstable for K₂ > 0. The
printed sign is kept as an option so that anyone can see it diverge.
The classical MSO (Eq. 4) is the same observer with f̂ = f(X̂) + B d̂.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import compiled, copy, inner
from dnnmso_mj.scenario import Observer as ObserverSpec
from dnnmso_mj.scenario import expand

Array = np.ndarray


class StateObserver(NamedTuple):
    """The observer at the control period: explicit Euler, since f̂, u and X are held in it."""

    x_hat: Array  # X̂ (2n,)
    e_obs: Array  # e_a (2n,) of the last `compare`
    gain: Array  # K₂ (2n,) with the sign of its feedback
    dt: float  # s


def build_observer(spec: ObserverSpec, n_states: int, dt: float) -> StateObserver:
    """The observer of a scenario for 2n states and control period dt (s)."""
    sign = 1.0 if spec.feedback == "stable" else -1.0
    gain = sign * expand(spec.K2, n_states)
    return StateObserver(np.zeros(n_states), np.zeros(n_states), gain, dt)


@compiled
def start(observer: StateObserver, x: Array) -> None:
    """Start at the measured state x (2n,): X̂₀ = X₀ (the paper's simulation section)."""
    copy(x, observer.x_hat)


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
