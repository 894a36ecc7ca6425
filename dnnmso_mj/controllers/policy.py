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

OWN = ("held", "tau")  # of the state; the rest is the policy's


class PolicyController:
    """A policy; it runs tick by tick, not compiled.

    Args:
        spec: where the policy is.
        scale: torque (n,) N·m of an action of 1.
        dt: control period (s).

    Raises:
        ScenarioError, MissingExtraError: as `LoadedPolicy`.
    """

    n_layers = 0

    def __init__(self, spec: Policy, scale: Array, dt: float) -> None:
        n = scale.size
        self._every = round((spec.control_timestep or dt) / dt)  # ticks
        self._held = 0  # ticks that the action has been held
        self._scale = scale
        self._observation = np.zeros(len(PARTS) * n)
        self._command = empty_command(n)
        self._policy = LoadedPolicy(spec, self._observation.size, n)

    def reset(self, x: Array) -> None:
        self._held = 0
        self._policy.reset()

    def update(self, inputs: Inputs) -> Command:
        if self._held == 0:
            self._act(inputs)
        self._held = (self._held + 1) % self._every
        show_measured(self._command, inputs.x)
        return self._command

    def _act(self, inputs: Inputs) -> None:
        observe(inputs, self._observation)
        action = self._policy(self._observation.copy())  # the policy may keep or change it
        if not np.isfinite(action).all():
            raise NonFiniteError("the policy's action", action.tolist())
        torque(action, self._scale, self._command.tau)

    def dynamics(self, x: Array) -> Array:
        return np.zeros(x.size // 2)

    def state(self) -> dict[str, Array]:
        own = {"held": np.array([self._held]), "tau": self._command.tau.copy()}
        return own | self._policy.state()

    def restore(self, state: Mapping[str, Array]) -> None:
        self._held = int(state["held"][0])
        self._command.tau[:] = state["tau"]
        self._policy.restore({name: state[name] for name in state if name not in OWN})
