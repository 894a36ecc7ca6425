"""A scenario as a Gymnasium environment: `dnnmso_mj/Tracking-v0`.

    import dnnmso_mj.environments.gym
    env = gymnasium.make("dnnmso_mj/Tracking-v0", scenario="paper")

or without the import, since Gymnasium 1.0 looks for no plug-ins by itself,

    env = gymnasium.make("dnnmso_mj.environments.gym:dnnmso_mj/Tracking-v0", scenario="paper")
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.utils import EzPickle

from dnnmso_mj.environments.episode import Episode, ticks_of
from dnnmso_mj.environments.start import Start, episode_scenario
from dnnmso_mj.errors import MissingExtraError, ScenarioError
from dnnmso_mj.observation import PARTS
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.tick import MUJOCO_ZEROES_ABOVE
from dnnmso_mj.trace import Trace
from dnnmso_mj.wording import did_you_mean

Array = np.ndarray

ID = "dnnmso_mj/Tracking-v0"
LARGEST = MUJOCO_ZEROES_ABOVE  # of an observation; finite, as Gymnasium wants it, and never reached
FRAME = (480, 480)  # px
SEEDS = 2**31  # that an episode without a seed is drawn from


class TrackingEnv(gymnasium.Env[Array, Array], EzPickle):
    """Follow a scenario's reference against its imperfections and events, by torque.

    Args:
        scenario: a shipped scenario's name, a file, or a loaded scenario; its controller has no
            part in it.
        sets: "a.b=c", changes to it.
        control_timestep: how long an action is held (s), whole steps; None: one step.
        torque_scale: torque of an action of 1 (N·m), one number or one a joint; None: the
            scenario's torque limit, or 128 without one.
        spread_q, spread_qd, random_phase: see `Start`.
        render_mode: None, or "rgb_array", which needs OpenGL.

    Raises:
        ScenarioError: as `load_scenario`; a time step that is no whole number of steps.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 1000}  # noqa: RUF012

    def __init__(
        self,
        scenario: Scenario | str | Path = "paper",
        sets: tuple[str, ...] = (),
        *,
        control_timestep: float | None = None,
        torque_scale: float | tuple[float, ...] | None = None,
        spread_q: float = 0.0,
        spread_qd: float = 0.0,
        random_phase: bool = False,
        render_mode: str | None = None,
    ) -> None:
        self._start = Start(spread_q, spread_qd, random_phase)
        EzPickle.__init__(
            self,
            scenario,
            sets,
            control_timestep=control_timestep,
            torque_scale=torque_scale,
            **asdict(self._start),
            render_mode=render_mode,
        )
        if render_mode not in {None, *self.metadata["render_modes"]}:
            raise ScenarioError(f'render_mode = {render_mode}; allowed: None or "rgb_array"')
        self.episode = Episode(scenario, tuple(sets), torque_scale)
        self._scenario = self.episode.scenario
        self._ticks = ticks_of(control_timestep, self._scenario)
        n = self._scenario.n_joints
        self.action_space = Box(-1.0, 1.0, (n,), np.float64)
        self.observation_space = Box(-LARGEST, LARGEST, (len(PARTS) * n,), np.float64)
        fps = max(1, round(1.0 / (self._ticks * self._scenario.dt)))
        self.metadata = {**self.metadata, "render_fps": fps}
        self.render_mode = render_mode
        self._renderer: Any = None

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: the scenario's seed of this episode, of all noise in it; None: one that is drawn.
            options: `spread_q`, `spread_qd`, `random_phase` of this episode alone.

        Returns:
            The observation; the seed and the time (s).

        Raises:
            ScenarioError: unknown options, or none of their values.
        """
        super().reset(seed=seed)
        start = replace(self._start, **_known(options or {}))
        chosen = int(self.np_random.integers(SEEDS)) if seed is None else seed
        self.episode.restart(episode_scenario(self._scenario, chosen, start))
        return self.episode.observation(), {"seed": chosen, "t": 0.0}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold an action (n,) for one control time step.

        Returns:
            The observation; the reward; whether the run has diverged, and whether the scenario is
            over; the time (s), and in the end `status`, `error` and the run's `metrics`.
        """
        episode = self.episode
        if episode.over:
            raise ResetNeeded("the episode is over: call reset")
        reward = episode.hold(episode.torque(action), self._ticks)
        info: dict[str, Any] = {"t": episode.t}
        diverged = bool(episode.error)
        if episode.over:
            status = "diverged" if diverged else "ok"
            info |= {"status": status, "error": episode.error, "metrics": episode.metrics()}
        return episode.observation(), reward, diverged, episode.over and not diverged, info

    def trace(self) -> Trace:
        """The episode so far, as `simulate` returns a run."""
        return self.episode.trace()

    def render(self) -> Array | None:
        """The arm from its model's own point of view, an image (h, w, 3) of bytes.

        Raises:
            MissingExtraError: there is no OpenGL.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render: the environment was made without a render_mode")
            return None
        if self._renderer is None:
            self._renderer = _renderer(self.episode)
        self.episode.place()
        self._renderer.viewer.make_context_current()  # another environment's may be
        image: Array = self._renderer.render("rgb_array")
        return image

    def close(self) -> None:
        """Give back what rendering holds."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def _known(options: Mapping[str, Any]) -> Mapping[str, Any]:
    known = asdict(Start())
    for name in options:
        if name not in known:
            allowed = f"allowed: {', '.join(known)}{did_you_mean(name, known)}"
            raise ScenarioError(f"options: no option {name}; {allowed}")
    return options


def _renderer(episode: Episode) -> Any:
    """Gymnasium's renderer of the plant."""
    model, data = episode.plant.model, episode.plant.data
    view = model.vis.global_
    camera = {
        "lookat": model.stat.center,
        "distance": 2.0 * model.stat.extent,
        "azimuth": view.azimuth,
        "elevation": view.elevation,
    }
    told = {"DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"} & set(os.environ)
    headless = sys.platform == "linux" and not told
    try:
        if headless:
            os.environ["MUJOCO_GL"] = "egl"  # what it takes by itself needs a display
        from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

        renderer = MujocoRenderer(model, data, camera, *FRAME)
        renderer.render("rgb_array")
    except Exception as error:  # of GL's libraries, each its own
        raise MissingExtraError(
            f"render_mode = rgb_array needs OpenGL: {type(error).__name__}: {error}; without a "
            "display set MUJOCO_GL=egl, and install libegl1 and libgl1-mesa-dri"
        ) from error
    finally:
        if headless:
            del os.environ["MUJOCO_GL"]
    return renderer


gymnasium.register(ID, f"{__name__}:TrackingEnv")
