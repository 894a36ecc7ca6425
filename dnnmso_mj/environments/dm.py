"""A scenario as a dm_control environment, a Physics and a Task in its idiom.

environment = dm.load("paper")
dm_control.viewer.launch(environment)
"""

from __future__ import annotations

import warnings
from collections import OrderedDict
from pathlib import Path

import numpy as np

with warnings.catch_warnings(action="ignore"):  # it looks for a display; none is needed
    from dm_control import mujoco
    from dm_control.mujoco import wrapper
    from dm_control.rl import control
from dm_env import specs

from dnnmso_mj.environments.episode import Episode, ticks_of
from dnnmso_mj.environments.start import Start, episode_scenario
from dnnmso_mj.metrics import Metrics
from dnnmso_mj.observation import PARTS
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.trace import Trace

Array = np.ndarray


def load(
    scenario: Scenario | str | Path = "paper",
    sets: tuple[str, ...] = (),
    *,
    control_timestep: float | None = None,
    torque_scale: float | tuple[float, ...] | None = None,
    spread_q: float = 0.0,
    spread_qd: float = 0.0,
    random_phase: bool = False,
    flat_observation: bool = False,
) -> control.Environment:
    """A scenario as an environment; it ends with the scenario, or at a divergence.

    Episodes have the seeds s, s + 1, s + 2, … of the scenario's seed s.

    Args:
        scenario: a shipped scenario's name, a file, or a loaded scenario; its controller has no
            part in it.
        sets: "a.b=c", changes to it.
        control_timestep: how long an action is held (s), whole steps; None: one step.
        torque_scale: torque of an action of 1 (N·m), one number or one a joint; None: the
            scenario's torque limit, or 128 without one.
        spread_q, spread_qd, random_phase: see `Start`.
        flat_observation: one vector instead of named parts.

    Raises:
        ScenarioError: as `load_scenario`; a time step that is no whole number of steps.
    """
    episode = Episode(scenario, tuple(sets), torque_scale)
    physics = TrackingPhysics(episode)
    task = TrackingTask(episode, Start(spread_q, spread_qd, random_phase))
    ticks = ticks_of(control_timestep, episode.scenario)
    return control.Environment(  # the task knows the time limit to the tick
        physics, task, n_sub_steps=ticks, flat_observation=flat_observation
    )


class TrackingPhysics(mujoco.Physics):  # type: ignore[misc]
    """The scenario's plant as dm_control sees one; controls are torques (N·m).

    Args:
        episode: what a step advances, imperfections and events included.
    """

    def __init__(self, episode: Episode) -> None:
        self.episode = episode
        self._tau = np.zeros(episode.scenario.n_joints)
        self.reward = 0.0  # of the last step
        super().__init__(wrapper.MjData(episode.plant.data))

    def set_control(self, control: Array) -> None:
        """The torque (n,) N·m that is asked for from now on."""
        self._tau[:] = control

    def step(self, nstep: int = 1) -> None:
        """Advance by some ticks of the scenario; at its end nothing moves any more."""
        if not self.episode.over:
            self.reward = self.episode.hold(self._tau, nstep)
            self.episode.place()

    def time(self) -> float:
        """Of the scenario (s)."""
        return self.episode.t


class TrackingTask(control.Task):  # type: ignore[misc]
    """Follow the scenario's reference.

    Args:
        episode: that of the physics.
        start: what each episode draws anew.
    """

    def __init__(self, episode: Episode, start: Start) -> None:
        self._episode, self._start = episode, start
        self._scenario = episode.scenario
        self._seed = self._scenario.seed

    @property
    def error(self) -> str:
        """Why the episode ended before its time; "" if it did not."""
        return self._episode.error

    @property
    def metrics(self) -> Metrics:
        """What any run is judged by, of the episode so far."""
        return self._episode.metrics()

    def trace(self) -> Trace:
        """The episode so far, as `simulate` returns a run."""
        return self._episode.trace()

    def initialize_episode(self, physics: TrackingPhysics) -> None:
        """Begin the scenario with the next seed."""
        scenario = episode_scenario(self._scenario, self._seed, self._start)
        self._episode.restart(scenario)
        self._seed += 1

    def before_step(self, action: Array, physics: TrackingPhysics) -> None:
        """Ask for the torque of an action (n,)."""
        physics.set_control(self._episode.torque(action))

    def action_spec(self, physics: TrackingPhysics) -> specs.BoundedArray:
        """n numbers from −1 to 1."""
        shape = self._episode.scale.shape
        return specs.BoundedArray(shape, np.float64, -1.0, 1.0, name="action")

    def get_observation(self, physics: TrackingPhysics) -> OrderedDict[str, Array]:
        """The parts of the observation by name, each (n,); flattened it is the same vector."""
        values = np.split(self._episode.observation(), len(PARTS))
        return OrderedDict(zip(PARTS, values, strict=True))

    def get_reward(self, physics: TrackingPhysics) -> float:
        """The mean of the step's ticks; see `Episode.reward`."""
        return physics.reward

    def get_termination(self, physics: TrackingPhysics) -> float | None:
        """Discount 1 at the scenario's end, 0 at a divergence."""
        if not self._episode.over:
            return None
        return 0.0 if self._episode.error else 1.0
