"""A policy from outside as a controller: what it sees and does is in `observation`.

τ = scale · clip(policy(observation), −1, 1)
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dnnmso_mj.controllers import Command, Inputs
from dnnmso_mj.controllers.measured import empty_command, show_measured
from dnnmso_mj.errors import NonFiniteError
from dnnmso_mj.observation import PARTS, observe, torque
from dnnmso_mj.policies import LoadedPolicy
from dnnmso_mj.scenario.policy import Policy

Array = np.ndarray


class PolicyController:
    """A policy; it runs tick by tick, not compiled.

    Args:
        spec: where the policy is.
        scale: torque (n,) N·m of an action of 1.

    Raises:
        ScenarioError, MissingExtraError: as `LoadedPolicy`.
    """

    n_layers = 0

    def __init__(self, spec: Policy, scale: Array) -> None:
        n = scale.size
        self._scale = scale
        self._observation = np.zeros(len(PARTS) * n)
        self._command = empty_command(n)
        self._policy = LoadedPolicy(spec, self._observation.size, n)

    def reset(self, x: Array) -> None:
        self._policy.reset()

    def update(self, inputs: Inputs) -> Command:
        command = self._command
        observe(inputs, self._observation)
        action = self._policy(self._observation.copy())  # the policy may keep or change it
        if not np.isfinite(action).all():
            raise NonFiniteError("the policy's action", action.tolist())
        torque(action, self._scale, command.tau)
        show_measured(command, inputs.x)
        return command

    def dynamics(self, x: Array) -> Array:
        return np.zeros(x.size // 2)

    def state(self) -> dict[str, Array]:
        return self._policy.state()

    def restore(self, state: Mapping[str, Array]) -> None:
        self._policy.restore(state)
