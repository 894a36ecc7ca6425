"""Controllers from outside: a whole `Controller`, or an object that only says what torque to apply.

The least there is:

    class Pd:
        def __init__(self, setup, kp, kd):
            self.kp, self.kd = kp, kd

        def update(self, inputs):
            return -self.kp * (inputs.q - inputs.q_ref) - self.kd * (inputs.qd - inputs.qd_ref)
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dnnmso_mj.controllers import Command, Controller, Inputs
from dnnmso_mj.controllers.measured import empty_command
from dnnmso_mj.errors import ExternalError, ScenarioError
from dnnmso_mj.external import CONTROLLER_STREAM, Setup, called, make
from dnnmso_mj.external.keeping import Kept
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import External, Scenario
from dnnmso_mj.wording import show

Array = np.ndarray

GROUP = "dnnmso_mj.controllers"
KEY = "controller.python"
WHOLE = ("reset", "update", "dynamics", "state", "restore")


def build_external(scenario: Scenario, spec: External, mjcf: Mjcf) -> Controller:
    """The controller that a scenario takes from outside; it runs tick by tick, interpreted.

    Raises:
        ScenarioError: it cannot be made, or lacks a method, which is named.
        ExternalError: its state cannot be kept.
    """
    setup = Setup.of(scenario, mjcf, CONTROLLER_STREAM)
    found = make(spec.python, KEY, GROUP, setup, spec.settings)
    return adapt(found, setup, KEY, spec.python)


def adapt(found: Any, setup: Setup, key: str, python: str) -> Controller:
    """A `Controller` of an object from outside.

    Args:
        found: a whole Controller, which has `n_layers`; or a law with `update(inputs)` that gives
            the torque (n,) N·m, and perhaps `reset(x)`, `dynamics(x)`, `state()`, `restore(state)`.
        setup: what it was made with.
        key, python: what the scenario named it by, for messages.

    Raises:
        ScenarioError: a method is missing.
    """
    whole = hasattr(found, "n_layers")
    wanted = WHOLE if whole else ("update",)
    missing = [name for name in wanted if not callable(getattr(found, name, None))]
    if missing:
        what = "a whole Controller" if whole else "update(inputs), which gives the torque"
        raise ScenarioError(
            f"{key} = {show(python)}: {type(found).__name__} has no {', no '.join(missing)}; "
            f"allowed: {what}"
        )
    return _Whole(found, setup) if whole else _Law(found, setup)


class _Law:
    """A law that gives torques; the rest of its commands shows what was measured."""

    n_layers = 0

    def __init__(self, law: Any, setup: Setup) -> None:
        self._law, self._n = law, setup.n_joints
        self._who = type(law).__name__
        self._kept = Kept(law, setup, self._who)
        self._reset = getattr(law, "reset", None)
        self._dynamics = getattr(law, "dynamics", None)
        self._command = empty_command(setup.n_joints)

    def reset(self, x: Array) -> None:
        if self._reset is not None:
            with called(f"{self._who}.reset"):
                self._reset(x.copy())

    def update(self, inputs: Inputs) -> Command:
        command, n = self._command, self._n
        with called(f"{self._who}.update"):
            tau = np.asarray(self._law.update(inputs), dtype=float)
        command.tau[:] = _shaped(tau, (n,), f"{self._who}.update", "a torque (N·m)")
        command.x_hat[:] = inputs.x
        command.f_hat[:n] = inputs.x[n:]
        return command

    def dynamics(self, x: Array) -> Array:
        if self._dynamics is None:
            return np.zeros(self._n)
        with called(f"{self._who}.dynamics"):
            drift = np.asarray(self._dynamics(x), dtype=float)
        return _shaped(drift, (self._n,), f"{self._who}.dynamics", "an acceleration (rad/s²)")

    def state(self) -> dict[str, Array]:
        return self._kept.state()

    def restore(self, state: Mapping[str, Array]) -> None:
        self._kept.restore(state)


class _Whole:
    """A `Controller` whose commands are checked before the loop takes them."""

    def __init__(self, controller: Any, setup: Setup) -> None:
        self._controller, self._n = controller, setup.n_joints
        self._who = type(controller).__name__
        self._kept = Kept(controller, setup, self._who)
        self.n_layers = int(controller.n_layers)
        self._checked: Command | None = None

    def reset(self, x: Array) -> None:
        with called(f"{self._who}.reset"):
            self._controller.reset(x.copy())

    def update(self, inputs: Inputs) -> Command:
        with called(f"{self._who}.update"):
            command: Command = self._controller.update(inputs)
        if command is not self._checked:
            self._check(command)
            self._checked = command
        return command

    def dynamics(self, x: Array) -> Array:
        with called(f"{self._who}.dynamics"):
            drift = np.asarray(self._controller.dynamics(x), dtype=float)
        return _shaped(drift, (self._n,), f"{self._who}.dynamics", "an acceleration (rad/s²)")

    def state(self) -> dict[str, Array]:
        return self._kept.state()

    def restore(self, state: Mapping[str, Array]) -> None:
        self._kept.restore(state)

    def _check(self, command: Command) -> None:
        """The compiled loop reads these arrays without looking: they must be as they should be."""
        who = f"{self._who}.update"
        if not isinstance(command, Command):
            kind = type(command).__name__
            raise ExternalError(f"{who} gives {kind}; allowed: a Command")
        sizes = dict.fromkeys(("Bu", "x_hat", "f_hat", "e_obs"), (2 * self._n,))
        for name, shape in {"tau": (self._n,), **sizes}.items():
            _check_array(getattr(command, name), shape, f"{who}: Command.{name}")
        for name, values in command.monitors._asdict().items():
            shape = (1,) if name in {"drt_bound", "clipped"} else (self.n_layers,)
            _check_array(values, shape, f"{who}: Command.monitors.{name}")


def _check_array(values: Any, shape: tuple[int, ...], what: str) -> None:
    good = isinstance(values, np.ndarray) and values.dtype == float and values.flags.c_contiguous
    if not good or values.shape != shape:
        found = f"{values.dtype} {values.shape}" if isinstance(values, np.ndarray) else values
        raise ExternalError(f"{what} is {found}; allowed: a contiguous float64 array {shape}")


def _shaped(values: Array, shape: tuple[int, ...], who: str, what: str) -> Array:
    if values.shape != shape:
        raise ExternalError(f"{who} gives an array {values.shape}; allowed: {what} {shape}")
    return values
