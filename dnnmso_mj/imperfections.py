"""What stands between the commanded torque and the arm."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import inner
from dnnmso_mj.scenario import Imperfections, expand

Array = np.ndarray


class Actuators(NamedTuple):
    """τ = clamp(τ_cmd, ±τ_max), each joint by its own limit."""

    tau: Array  # (n,) N·m, what reaches the joints
    limit: Array  # (n,) N·m; infinite without one


def build_actuators(spec: Imperfections, n_joints: int) -> Actuators:
    """The actuators of a scenario."""
    limit = spec.torque_limit
    limits = np.full(n_joints, np.inf) if limit is None else expand(limit, n_joints)
    return Actuators(np.zeros(n_joints), limits)


@inner
def actuate(actuators: Actuators, tau_cmd: Array) -> bool:
    """Pass a command (n,) N·m through; whether anything was clamped."""
    saturated = False
    for i in range(tau_cmd.size):
        tau, limit = tau_cmd[i], actuators.limit[i]
        if abs(tau) > limit:
            tau = math.copysign(limit, tau)
            saturated = True
        actuators.tau[i] = tau
    return saturated
