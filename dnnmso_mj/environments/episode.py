"""A scenario that torques from outside drive, tick by tick, by the very code of `simulate`."""

from __future__ import annotations

import time
from pathlib import Path

import mujoco
import numpy as np

from dnnmso_mj.compile_loop import compile_halves_elsewhere
from dnnmso_mj.consistency import MULTIPLE, is_multiple
from dnnmso_mj.controllers.measured import empty_command, show_measured
from dnnmso_mj.errors import DnnmsoError, EndedEarlyError, ScenarioError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.metrics import Metrics, compute_metrics
from dnnmso_mj.observation import PARTS, observe, torque, torque_scale
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf, Plant
from dnnmso_mj.scenario import Policy, Scenario
from dnnmso_mj.stage import Stage
from dnnmso_mj.trace import Event, RunInfo, StepLayout, Trace

Array = np.ndarray

PRECISION = 0.1  # rad: an error of this size halves the reward
EFFORT = 0.05  # share of the reward that full torque on all joints costs


def outside() -> None:
    """What drives an episode, as its scenario names it: nothing that could be run again.

    Raises:
        DnnmsoError: always.
    """
    raise DnnmsoError("the torques of this run came from outside, and its scenario has them not")


class Episode:
    """A scenario driven from outside; call `restart` first.

    Args:
        scenario: the experiment, or what `load_scenario` takes; its controller has no part in it.
        sets: "a.b=c", where `scenario` is to be loaded.
        scale: torque of an action of 1 (N·m), one number or one a joint; None: the torque limit,
            or 128 without one.

    Attributes:
        scenario: of the episode.
        plant: its arm.
        scale: as given, (n,).
        over: whether the end was reached.
        error: why it was reached before its time; "" otherwise.

    Raises:
        ScenarioError: as `load_scenario` and `Stage`.
    """

    def __init__(
        self,
        scenario: Scenario | str | Path,
        sets: tuple[str, ...] = (),
        scale: float | tuple[float, ...] | None = None,
    ) -> None:
        if not isinstance(scenario, Scenario):
            scenario = load_scenario(scenario, sets)
        elif sets:
            raise ScenarioError(f"sets = {list(sets)}; allowed: none beside a loaded scenario")
        each = None if scale is None else _positive(scale, scenario.n_joints)
        scenario = _driven_from_outside(scenario, each)
        self.scale = torque_scale(scenario, each)
        self._command = empty_command(scenario.n_joints)
        mjcf = Mjcf.read(find_model(scenario.plant.model))
        self.scenario = scenario
        self.plant = Plant(scenario, mjcf)
        self._stage = Stage(scenario, mjcf, self.plant, StepLayout(scenario.n_joints, n_layers=0))
        compile_halves_elsewhere(self._stage.world, scenario, mjcf)
        self.over, self.error = True, ""

    @property
    def t(self) -> float:
        """Time of the next tick (s)."""
        return self._tick * self.scenario.dt

    def restart(self, scenario: Scenario) -> None:
        """Go to the start.

        Args:
            scenario: the episode's own, which differs from the first in seed, initial state and
                reference alone: see `start.episode_scenario`.
        """
        self.scenario = scenario
        self._recorder = MemoryRecorder(self._stage.layout, scenario.n_ticks)
        self.over, self.error = False, ""
        self._began, self._tick = time.perf_counter(), 0
        self._stage.vary(scenario)
        self._stage.start()
        self._open_block()
        self._sense()

    def observation(self) -> Array:
        """What is told of the present tick: a new vector (6n,); see `observation`."""
        out = np.empty(len(PARTS) * self.scenario.n_joints)
        observe(self._stage.world.inputs, out)
        return out

    def torque(self, action: Array) -> Array:
        """The torque (n,) N·m of an action (n,).

        Raises:
            DnnmsoError: the action has another shape.
        """
        tau, asked = np.empty(self.scenario.n_joints), np.asarray(action, dtype=float)
        if asked.shape != tau.shape:
            raise DnnmsoError(
                f"an action of shape {asked.shape}; allowed: {tau.shape}, one number a joint"
            )
        torque(asked, self.scale, tau)
        return tau

    def hold(self, tau: Array, ticks: int) -> float:
        """Hold a torque (n,) N·m for some ticks, or until the end.

        Returns:
            The mean of these ticks' rewards: see `reward`.

        Raises:
            DnnmsoError: the episode is over.
        """
        if self.over:
            raise DnnmsoError("the episode is over; restart it")
        total, done = 0.0, 0
        while done < ticks and not self.over:
            self._advance(tau)
            total += self.reward()
            done += 1
        return total / done

    def reward(self) -> float:
        """1/(1 + (‖e‖/ε)²) · (1 − w ‖τ/scale‖²/n) of the true e = q − q_ref now; in [0, 1].

        ε = 0.1 rad, w = 0.05; τ is what was asked for in the tick before. After a divergence 0.
        N.B. it is never negative, so that no policy gains by ending an episode early.
        """
        if self.error:
            return 0.0
        n = self.scenario.n_joints
        e, share = self._stage.world.e_track[:n], self._command.tau / self.scale
        near = 1.0 / (1.0 + float(e @ e) / PRECISION**2)
        return near * max(0.0, 1.0 - EFFORT * float(share @ share) / n)

    def place(self) -> None:
        """Put bodies and cameras where the present angles have them, for who looks at them."""
        mujoco.mj_fwdPosition(self.plant.model, self.plant.data)

    def trace(self) -> Trace:
        """The episode so far, as `simulate` returns a run."""
        if not self.over:
            self._stage.close_block(self._recorder)
            self._open_block()
        status = "diverged" if self.error else "ok" if self.over else "unfinished"
        wall = time.perf_counter() - self._began
        info = RunInfo(status, self.scenario.seed, wall, reason=self.error)
        return self._recorder.trace(self.scenario, info)

    def metrics(self) -> Metrics:
        """What any run is judged by: see `compute_metrics`."""
        return compute_metrics(self.trace())

    def _advance(self, tau: Array) -> None:
        """One tick from its command on, and the next one up to what is told of it."""
        stage = self._stage
        show_measured(self._command, stage.world.inputs.x)
        self._command.tau[:] = tau
        try:
            if stage.act(self._tick, self._command):
                stage.close_block(self._recorder)
                self._end_early(stage.divergence())
                return
            self._tick += 1
            self.over = self._tick == self.scenario.n_ticks
            if self._tick == self._block_end:
                stage.close_block(self._recorder)
                self._open_block()
            self._sense()
            if self.over and not self.error:
                stage.check_end()
        except EndedEarlyError as error:  # of an imperfection from outside, or at the end
            stage.close_block(self._recorder)
            self._end_early(error)

    def _sense(self) -> None:
        """What is told of the present tick; the last one's once more, if that is not finite."""
        stage, told = self._stage, self._stage.world.inputs.x
        before = told.copy()
        stage.sense(self._tick)
        if stage.ended:
            stage.close_block(self._recorder)
            self._end_early(stage.divergence())
            told[:] = before

    def _open_block(self) -> None:
        """Rows are kept block by block, as a run's are; what is due now happens."""
        self._block_end = self._stage.open_block(self._recorder)

    def _end_early(self, error: EndedEarlyError) -> None:
        self._tick = self._stage.tick
        self.over, self.error = True, f"{error} at t = {self.t:.6g} s"
        self._recorder.event(Event(self.t, "error", f"diverged: {self.error}"))


def _driven_from_outside(scenario: Scenario, scale: tuple[float, ...] | None) -> Scenario:
    """The scenario with `outside` for its controller, so that nothing of its own one is left."""
    name = f"{outside.__module__}:{outside.__qualname__}"
    driver = Policy(kind="policy", python=name, torque_scale=scale)
    return scenario.model_copy(update={"controller": driver})


def _positive(scale: float | tuple[float, ...], n_joints: int) -> tuple[float, ...]:
    values = np.ravel(np.array(scale, dtype=float))
    if values.size not in {1, n_joints} or not (np.isfinite(values) & (values > 0.0)).all():
        raise ScenarioError(
            f"torque_scale = {scale}; allowed: a number > 0 (N·m), or {n_joints}, one a joint"
        )
    return tuple(values.tolist())


def ticks_of(control_timestep: float | None, scenario: Scenario) -> int:
    """How many ticks an action is held.

    Raises:
        ScenarioError: a time that is no whole number of steps.
    """
    if control_timestep is None:
        return 1
    if not is_multiple(control_timestep, scenario):
        problem = f"is no {MULTIPLE.format(scenario.dt)}"
        raise ScenarioError(f"control_timestep = {control_timestep}: {problem}")
    return round(control_timestep / scenario.dt)
