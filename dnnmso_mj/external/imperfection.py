"""Imperfections from outside: what they do to readings and to torques, between two compiled halves.

    arm → sensors → sense(t, x) → controller → actuate(t, tau) → limits, delay, lag → arm

Each is an object with `sense`, `actuate` or both, and perhaps `reset()`, `state()` and `restore`.
Several act in the order of the scenario. Torques of a real-time run's watchdog pass them by.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from dnnmso_mj.errors import ExternalError, NonFiniteError, ScenarioError
from dnnmso_mj.external import IMPERFECTION_STREAM, Setup, called, make
from dnnmso_mj.external.keeping import Kept
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.wording import show

Array = np.ndarray
Hook = tuple[str, Callable[[float, Array], Any]]

GROUP = "dnnmso_mj.imperfections"


class Hooks:
    """All imperfections that a scenario takes from outside; falsy without any.

    Args:
        scenario: the experiment.
        mjcf: the model that it names.

    Raises:
        ScenarioError: one cannot be made, or has neither `sense` nor `actuate`.
        ExternalError: the state of one cannot be kept.
    """

    def __init__(self, scenario: Scenario, mjcf: Mjcf) -> None:
        self._kept: list[Kept] = []
        self._resets: list[Hook] = []
        self._sense: list[Hook] = []
        self._actuate: list[Hook] = []
        for k, spec in enumerate(scenario.imperfections.external):
            setup = Setup.of(scenario, mjcf, IMPERFECTION_STREAM, k)
            key = f"imperfections.external.{k}.python"
            self._add(make(spec.python, key, GROUP, setup, spec.settings), setup, key, spec.python)
        self._first = self.state()

    def __bool__(self) -> bool:
        return bool(self._kept)

    def start(self) -> None:
        """As they were made, for a run from its beginning."""
        self.restore(self._first)
        for who, reset in self._resets:
            with called(who):
                reset()  # type: ignore[call-arg]

    def sense(self, t: float, x: Array) -> None:
        """Change a reading x = [q; q̇] (2n,) of time t (s) in place.

        Raises:
            NonFiniteError: it is not finite any more.
        """
        for hook in self._sense:
            x[:] = _answer(hook, t, x)

    def actuate(self, t: float, tau: Array) -> Array:
        """What the drives are given at time t (s) where `tau` (n,) N·m was commanded.

        Raises:
            NonFiniteError: it is not finite any more.
        """
        for hook in self._actuate:
            tau = _answer(hook, t, tau)
        return tau

    def state(self) -> dict[str, Array]:
        """A copy of all that what they do next depends on."""
        return {
            f"{k}.{name}": values
            for k, kept in enumerate(self._kept)
            for name, values in kept.state().items()
        }

    def restore(self, state: Mapping[str, Array]) -> None:
        """Put a `state` back; one that is not in it stays as it is."""
        for k, kept in enumerate(self._kept):
            prefix = f"{k}."
            own = {n.removeprefix(prefix): v for n, v in state.items() if n.startswith(prefix)}
            if own:
                kept.restore(own)

    def _add(self, found: Any, setup: Setup, key: str, python: str) -> None:
        name = type(found).__name__
        self._kept.append(Kept(found, setup, name))
        parts = {"sense": self._sense, "actuate": self._actuate, "reset": self._resets}
        for method, hooks in parts.items():
            hook = getattr(found, method, None)
            if callable(hook):
                hooks.append((f"{key.removesuffix('.python')}: {name}.{method}", hook))
        if not (hasattr(found, "sense") or hasattr(found, "actuate")):
            raise ScenarioError(
                f"{key} = {show(python)}: {name} has neither sense nor actuate; "
                "allowed: sense(t, x), actuate(t, tau), or both"
            )


def _answer(hook: Hook, t: float, values: Array) -> Array:
    """What a hook makes of some values, of the same shape and finite."""
    who, function = hook
    with called(who):
        found = np.array(function(t, values.copy()), dtype=float)
    if found.shape != values.shape:
        raise ExternalError(f"{who} gives an array {found.shape}; allowed: {values.shape}")
    if not np.isfinite(found).all():
        raise NonFiniteError(who, found.tolist())
    return found
