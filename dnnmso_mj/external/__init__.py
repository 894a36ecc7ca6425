"""Code from outside this package: what it is told, how it is called, and how it fails.

A scenario names it by `python` (see `dnnmso_mj.importing`). A controller or an imperfection is made
by calling what is named with a `Setup` and the scenario's `settings` by name; a reference is the
function itself. docs/extending.md has an example of each.
"""

from __future__ import annotations

import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from dnnmso_mj.errors import DnnmsoError, ExternalError, ScenarioError
from dnnmso_mj.importing import import_named
from dnnmso_mj.plant import Mjcf, NominalModel
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.wording import clean, show

# What a scenario's seed is joined by; the sensors' own streams have keys of one number.
CONTROLLER_STREAM, IMPERFECTION_STREAM = 1000, 1001


@dataclass(frozen=True)
class Setup:
    """What a controller or an imperfection from outside is told of the run that it is for.

    Args:
        n_joints: n.
        dt: control period (s).
        seed: of the scenario.
        rng: random numbers of its own, from that seed; its state is kept in logs.
        nominal: what the scenario's controller believes of the robot: `inertia(q)` gives M (n, n)
            kg·m², `bias(q, qd)` gives V + G (n,) N·m; each overwritten by the next call.
    """

    n_joints: int
    dt: float
    seed: int
    rng: np.random.Generator
    nominal: NominalModel

    @classmethod
    def of(cls, scenario: Scenario, mjcf: Mjcf, *stream: int) -> Setup:
        """Of a scenario and its model, with the random numbers of that stream."""
        seeds = np.random.SeedSequence(scenario.seed, spawn_key=stream)
        return cls(
            n_joints=scenario.n_joints,
            dt=scenario.dt,
            seed=scenario.seed,
            rng=np.random.default_rng(seeds),
            nominal=NominalModel(scenario, mjcf),
        )


def make(python: str, key: str, group: str, setup: Setup, settings: Mapping[str, Any]) -> Any:
    """What the factory that a scenario names makes of its settings.

    Args:
        python: as the scenario has it.
        key: the key path that holds it, for messages.
        group: of entry points.
        setup, settings: what the factory is called with.

    Raises:
        ScenarioError: it cannot be imported, is not callable, or fails.
    """
    factory = import_callable(python, key, group)
    try:
        return factory(setup, **settings)
    except DnnmsoError:
        raise
    except Exception as error:  # whatever foreign code raises
        raise ScenarioError(
            f"{key} = {show(python)}: called with (setup, {', '.join(settings) or 'no settings'}) "
            f"it fails: {told(error)}; allowed: a class or function that takes the settings by name"
        ) from error


def import_callable(python: str, key: str, group: str) -> Any:
    """The class or function that a scenario names.

    Raises:
        ScenarioError: it cannot be imported, or is not callable.
    """
    found = import_named(python, key, group)
    if not callable(found):
        kind = type(found).__name__
        raise ScenarioError(f"{key} = {show(python)}: is of {kind}; allowed: a class or function")
    return found


@contextmanager
def called(who: str) -> Iterator[None]:
    """Inside, whatever foreign code raises becomes an ExternalError that says who and where."""
    try:
        yield
    except DnnmsoError:
        raise
    except Exception as error:  # whatever foreign code raises
        raise ExternalError(f"{who} fails: {told(error)}") from error


def told(error: Exception) -> str:
    """An exception with the place that raised it."""
    frames = traceback.extract_tb(error.__traceback__)[1:]  # the first is the caller's
    place = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {clean(' '.join(str(error).split()))}{place}"
