"""The state observer whose error trains the network.

    X̂̇ = f̂ + B u + K₂ (X − X̂)      ⇒      ė_a = f̃ − K₂ e_a,   e_a = X − X̂

N.B. the paper's Eq. 5 prints −K₂ (X − X̂), which makes ė_a = f̃ + K₂ e_a: unstable for K₂ > 0. The
printed sign is kept as an option so that anyone can see it diverge.
The classical MSO (Eq. 4) is the same observer with f̂ = f(X̂) + B d̂.
"""

from __future__ import annotations

import numpy as np

from dnnmso_mj.scenario import Observer as ObserverSpec
from dnnmso_mj.scenario import expand

Array = np.ndarray


class StateObserver:
    """The observer at the control period: explicit Euler, since f̂, u and X are held for a period.

    Args:
        spec: gain K₂ (1/s) and the sign of its feedback.
        n_states: 2n.
        dt: control period (s).

    Attributes:
        x_hat: X̂ (2n,).
        e_obs: e_a = X − X̂ (2n,) of the last `compare`.
    """

    def __init__(self, spec: ObserverSpec, n_states: int, dt: float) -> None:
        sign = 1.0 if spec.feedback == "stable" else -1.0
        self._dt = dt
        self._gain = sign * expand(spec.K2, n_states)
        self._rate = np.zeros(n_states)
        self.x_hat = np.zeros(n_states)
        self.e_obs = np.zeros(n_states)

    def reset(self, x: Array) -> None:
        """Start at the measured state: X̂₀ = X₀ (the paper's simulation section)."""
        self.x_hat[:] = x
        self.e_obs[:] = 0.0

    def compare(self, x: Array) -> Array:
        """e_a = X − X̂ (2n,) for the measured state x (2n,)."""
        np.subtract(x, self.x_hat, out=self.e_obs)
        return self.e_obs

    def advance(self, f_hat: Array, Bu: Array) -> None:
        """Integrate X̂ over one period with f̂ (2n,), B u (2n,) and the last e_a."""
        rate = np.multiply(self._gain, self.e_obs, out=self._rate)
        rate += f_hat
        rate += Bu
        rate *= self._dt
        self.x_hat += rate
