"""One step of the same arm in other people's hands: MuJoCo alone, dm_control, Gymnasium.

Each is the least one has to write to drive the arm by torque and read angles and velocities back.
"""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import mujoco
import numpy as np

from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import Scenario

Array = np.ndarray


class Arm(Protocol):
    """An arm that takes torque."""

    def step(self, tau: Array) -> object:
        """Hold τ (n,) N·m for one step dt."""

    def state(self) -> Array:
        """[q; q̇] (2n,)."""


class BareMujoco:
    """mj_step from Python."""

    def __init__(self, xml: str, q: Array, qd: Array) -> None:
        self._model = mujoco.MjModel.from_xml_string(xml)
        self._data = mujoco.MjData(self._model)
        self._data.qpos, self._data.qvel = q, qd

    def step(self, tau: Array) -> None:
        self._data.ctrl[:] = tau
        mujoco.mj_step(self._model, self._data)

    def state(self) -> Array:
        return np.concatenate([self._data.qpos, self._data.qvel])


class ControlSuite:
    """dm_control's Environment around a Physics of the arm and a task without reward."""

    def __init__(self, xml: str, q: Array, qd: Array) -> None:
        with warnings.catch_warnings(action="ignore"):  # it looks for a display; none is needed
            from dm_control import mujoco as dm_mujoco
            from dm_control.rl import control

        class Drive(control.Task):  # type: ignore[misc]
            def initialize_episode(self, physics: Any) -> None:
                with physics.reset_context():
                    physics.data.qpos[:], physics.data.qvel[:] = q, qd

            def before_step(self, action: Array, physics: Any) -> None:
                physics.set_control(action)

            def after_step(self, physics: Any) -> None:
                pass

            def action_spec(self, physics: Any) -> Any:
                return dm_mujoco.action_spec(physics)

            def get_observation(self, physics: Any) -> dict[str, Array]:
                return {"q": physics.data.qpos.copy(), "qd": physics.data.qvel.copy()}

            def get_reward(self, physics: Any) -> float:
                return 0.0

        physics = dm_mujoco.Physics.from_xml_string(xml)
        self._environment = control.Environment(
            physics, Drive(), n_sub_steps=1, time_limit=float("inf")
        )
        self._observation = self._environment.reset().observation

    def step(self, tau: Array) -> None:
        self._observation = self._environment.step(tau).observation

    def state(self) -> Array:
        return np.concatenate([self._observation["q"], self._observation["qd"]])


class Gymnasium:
    """Gymnasium's MujocoEnv with the least a subclass has to add."""

    def __init__(self, xml: str, q: Array, qd: Array) -> None:
        from gymnasium.envs.mujoco import MujocoEnv
        from gymnasium.spaces import Box

        dt = float(mujoco.MjModel.from_xml_string(xml).opt.timestep)

        class Drive(MujocoEnv):
            metadata = {  # noqa: RUF012
                "render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"],
                "render_fps": round(1.0 / dt),
            }

            def _observe(self) -> Array:
                return np.concatenate([self.data.qpos, self.data.qvel])

            def reset_model(self) -> Array:
                self.set_state(np.array(q), np.array(qd))  # type: ignore[no-untyped-call]
                return self._observe()

            def step(self, action: Array) -> Any:
                self.do_simulation(action, self.frame_skip)
                return self._observe(), 0.0, False, False, {}

        space = Box(-np.inf, np.inf, shape=(2 * len(q),), dtype=np.float64)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "arm.xml"
            path.write_text(xml, encoding="utf-8")
            self._environment = Drive(str(path), frame_skip=1, observation_space=space)
        self._observation, _ = self._environment.reset()

    def step(self, tau: Array) -> None:
        self._observation, *_ = self._environment.step(tau)

    def state(self) -> Array:
        observation: Array = self._observation
        return observation


def arms(scenario: Scenario, mjcf: Mjcf) -> dict[str, Callable[[], Arm]]:
    """Name -> maker of an arm at the scenario's start; a maker may raise ImportError."""
    n = scenario.n_joints
    xml = mjcf.checked  # N.B. MjSpec.to_xml rounds the inertia of a point mass to zero
    q = np.array(scenario.initial.q)
    qd = np.resize(np.array(scenario.initial.qd), n)
    return {
        "bare mj_step from Python": lambda: BareMujoco(xml, q, qd),
        "dm_control, Environment.step": lambda: ControlSuite(xml, q, qd),
        "Gymnasium, MujocoEnv.step": lambda: Gymnasium(xml, q, qd),
    }
