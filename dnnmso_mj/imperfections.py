"""What stands between the commanded torque and the arm."""

from __future__ import annotations

import numpy as np

from dnnmso_mj.scenario import Imperfections, expand

Array = np.ndarray


class Actuators:
    """τ = clamp(τ_cmd, ±τ_max), each joint by its own limit.

    Args:
        spec: the scenario's imperfections.
        n_joints: n.

    Attributes:
        saturated: whether the last `apply` clamped anything.
    """

    def __init__(self, spec: Imperfections, n_joints: int) -> None:
        limit = spec.torque_limit
        self._limit = None if limit is None else expand(limit, n_joints)
        self._tau = np.zeros(n_joints)
        self.saturated = False

    def apply(self, tau_cmd: Array) -> Array:
        """Torque (n,) N·m that reaches the joints; overwritten by the next call."""
        if self._limit is None:
            return tau_cmd
        np.clip(tau_cmd, -self._limit, self._limit, out=self._tau)
        self.saturated = not np.array_equal(self._tau, tau_cmd)
        return self._tau
