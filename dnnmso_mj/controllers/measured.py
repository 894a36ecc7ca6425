"""The command of a controller that sees no more of the dynamics than the measured velocity."""

from __future__ import annotations

import numpy as np

from dnnmso_mj.compiling import inner
from dnnmso_mj.controllers import Command
from dnnmso_mj.monitors import Monitors

Array = np.ndarray


def empty_command(n_joints: int) -> Command:
    """A command of zeros for n joints, with arrays of its own and no network to watch."""
    Bu, x_hat, f_hat, e_obs = np.zeros((4, 2 * n_joints))
    return Command(np.zeros(n_joints), Bu, x_hat, f_hat, e_obs, Monitors.zeros(0))


@inner
def show_measured(command: Command, x: Array) -> None:
    """X̂ = X and f̂ = [q̇; 0] of the measured x = [q; q̇] (2n,): no observer, no model."""
    n = command.tau.size
    for i in range(n):
        command.x_hat[i], command.x_hat[n + i] = x[i], x[n + i]
        command.f_hat[i], command.f_hat[n + i] = x[n + i], 0.0
