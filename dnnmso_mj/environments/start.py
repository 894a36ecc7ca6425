"""How the episodes of an environment differ: each is a scenario of its own, made of its seed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.scenario import Scenario, expand

PHASED = ("sinusoid", "exp_sinusoid")
STREAM = 1002  # of random numbers; others are the sensors', and those of code from outside


@dataclass(frozen=True)
class Start:
    """What is drawn anew for each episode.

    Args:
        spread_q: half-width of the uniform spread of each initial angle (rad).
        spread_qd: the same of each initial velocity (rad/s).
        random_phase: whether each joint's reference begins at a random phase.
    """

    spread_q: float = 0.0
    spread_qd: float = 0.0
    random_phase: bool = False

    def __post_init__(self) -> None:
        for name in ("spread_q", "spread_qd"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ScenarioError(f"{name} = {value}; allowed: a number >= 0")


def episode_scenario(scenario: Scenario, seed: int, start: Start) -> Scenario:
    """The scenario of one episode; it is decided by the seed alone.

    Args:
        scenario: what all episodes have in common.
        seed: of its noise, and of what `start` draws.
        start: what is drawn.

    Raises:
        ScenarioError: the seed is out of range, or the reference has no phase.
    """
    if not 0 <= seed < 2**63:
        raise ScenarioError(f"seed = {seed}; allowed: a whole number from 0 to 2^63 - 1")
    n = scenario.n_joints
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(STREAM,)))
    initial, reference = scenario.initial, scenario.reference
    if start.spread_q or start.spread_qd:
        q = np.array(initial.q) + rng.uniform(-start.spread_q, start.spread_q, n)
        qd = expand(initial.qd, n) + rng.uniform(-start.spread_qd, start.spread_qd, n)
        initial = initial.model_copy(update={"q": tuple(q.tolist()), "qd": tuple(qd.tolist())})
    if start.random_phase:
        if reference.kind not in PHASED:
            allowed = f"allowed: references of kind {' or '.join(PHASED)}"
            raise ScenarioError(f"random_phase = true: a {reference.kind} has no phase; {allowed}")
        phase = tuple(rng.uniform(0.0, 2.0 * math.pi, n).tolist())
        reference = reference.model_copy(update={"phase": phase})
    return scenario.model_copy(update={"seed": seed, "initial": initial, "reference": reference})
