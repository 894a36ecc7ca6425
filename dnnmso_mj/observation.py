"""What a policy sees of a tick, and what its action does: the same in a run and in environments.

observation (6n,)   q, q̇ as measured (rad, rad/s); q_ref, q̇_ref, q̈_ref (rad, rad/s, rad/s²);
                    the torque that acted in the period before (N·m), zero before the first
action (n,)         τ_i = scale_i · clip(action_i, −1, 1)
"""

from __future__ import annotations

import numpy as np

from dnnmso_mj.controllers import Inputs
from dnnmso_mj.scenario import Scenario, expand

Array = np.ndarray

# Of the observation, each (n,), in this order.
PARTS = ("q", "qd", "q_ref", "qd_ref", "qdd_ref", "tau")

TORQUE_SCALE = 128.0  # N·m, where nothing else is said; a power of two, which rounds nothing


def observe(inputs: Inputs, out: Array) -> None:
    """What a controller is told, as one vector (6n,), into `out`."""
    n = inputs.tau.size
    out[: 2 * n] = inputs.x
    out[2 * n : 4 * n] = inputs.x_ref
    out[4 * n : 5 * n] = inputs.xd_ref[n:]
    out[5 * n :] = inputs.tau


def torque(action: Array, scale: Array, out: Array) -> None:
    """The torque (n,) N·m of an action (n,), into `out`; what is not finite stays so."""
    np.clip(action, -1.0, 1.0, out=out)
    out *= scale
    if not np.isfinite(action).all():
        out[:] = np.where(np.isfinite(action), out, action)


def torque_scale(scenario: Scenario, given: tuple[float, ...] | None = None) -> Array:
    """Torque (n,) N·m of an action of 1: as given, else the torque limit, else TORQUE_SCALE."""
    limit = scenario.imperfections.torque_limit
    return expand(given or limit or (TORQUE_SCALE,), scenario.n_joints)
