"""What an audit asks of whom, all validated before anything runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dnnmso_mj.audit.frozen import without_model
from dnnmso_mj.audit.region import region_of
from dnnmso_mj.audit.subject import Questions, Subject
from dnnmso_mj.audit.unseen import reference_states, unseen_trajectories
from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.loading.overrides import parse_overrides
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.simulation import simulate

STATES = 400  # that a model is asked about inside, and as many outside
LOOKS = 2000  # states of the reference that make the region


class AuditError(DnnmsoError):
    """An audit that cannot be accepted or written."""


@dataclass(frozen=True)
class AuditPlan:
    """A validated audit.

    Args:
        subjects: one a controller.
        questions: what each is asked.
        seeds: of the initial weights and of noise.
    """

    subjects: tuple[Subject, ...]
    questions: Questions
    seeds: tuple[int, ...]

    @property
    def name(self) -> str:
        """Of the scenario."""
        return self.subjects[0].scenario.name


def plan_audit(
    source: str,
    controllers: Sequence[str],
    at: Sequence[float],
    seeds: Sequence[int],
    sets: Sequence[str] = (),
    *,
    trust: bool = False,
) -> AuditPlan:
    """Validate an audit, and compile what its workers will load.

    Args:
        source: a scenario file, or the name of a shipped one.
        controllers: names as `load_scenario` takes them; none: the scenario's own.
        at: freeze times (s), any order.
        seeds: ascending.
        sets: "a.b=c", for every controller.
        trust: whether the scenario may name code by import path, as `load_scenario`.

    Raises:
        ScenarioError: as `load_scenario`.
        AuditError: a freeze time, a seed or a controller that cannot be accepted.
    """
    _check(controllers, sets)
    names = controllers or (None,)
    scenarios = [load_scenario(source, sets, name, trust=trust) for name in names]
    mjcf = Mjcf.read(find_model(scenarios[0].plant.model))
    times = _times(at, scenarios[0].dt)
    for scenario in scenarios:
        for law in (scenario, without_model(scenario)):
            tick = {"duration": scenario.dt, "events": ()}
            simulate(law.model_copy(update=tick), mjcf, watch=False)
    subjects = tuple(
        Subject(name or scenario.controller.kind, scenario, mjcf)
        for name, scenario in zip(names, scenarios, strict=True)
    )
    return AuditPlan(subjects, _questions(subjects[0], times), tuple(seeds))


def _questions(subject: Subject, at: tuple[float, ...]) -> Questions:
    """The region that the reference visits until the first freeze, and what follows from it."""
    scenario = subject.scenario
    times = np.linspace(0.0, at[0], LOOKS)
    region = region_of(reference_states(scenario.reference, scenario.n_joints, times))
    rng = np.random.default_rng(0)  # the same states for every controller and seed
    return Questions(
        at=at,
        region=region,
        unseen=unseen_trajectories(region),
        near=region.draw_inside(STATES, rng),
        outside=region.draw_outside(STATES, rng),
    )


def _times(at: Sequence[float], dt: float) -> tuple[float, ...]:
    """Freeze times, ascending, each once."""
    for time in at:
        if not np.isfinite(time) or time < dt:
            raise AuditError(f"--at {time:g}: no tick is before it; allowed: {dt:g} s or more")
    if not at:
        raise AuditError("--at: no time; allowed: one or more, as in 10,25,50")
    return tuple(sorted(set(at)))


def _check(controllers: Sequence[str], sets: Sequence[str]) -> None:
    twice = [name for k, name in enumerate(controllers) if name in controllers[:k]]
    if twice:
        raise AuditError(f"--controllers: {twice[0]} is there twice; allowed: each once")
    if any(item.path == ("seed",) for item in parse_overrides(sets)):
        raise AuditError("--set seed: has an option of its own; allowed: --seeds START:STOP")
