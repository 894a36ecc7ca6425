"""What an audit says: every measure over the seeds, for each controller and freeze time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dnnmso_mj.audit.subject import Row
from dnnmso_mj.sweep.statistics import Spread, spread

MEASURES = {
    "same_alone": "same trajectory, model alone",
    "same_fed": "with feed-forward",
    "same_none": "no model",
    "inside": "unseen, inside",
    "inside_none": "no model",
    "outside": "unseen, outside",
    "outside_none": "no model",
    "knowledge_visited": "knowledge, visited",
    "knowledge_near": "inside",
    "knowledge_outside": "outside",
}
"""Name in a row -> in words; the first seven are RMSE in rad."""


@dataclass(frozen=True)
class AuditPoint:
    """One controller, frozen at one time, over the seeds.

    Args:
        controller: its name.
        at: freeze time (s).
        runs: how many seeds.
        diverged: of how many seeds a run diverged; that measure lacks them.
        measures: name -> spread over the seeds that have a value; its n says how many.
    """

    controller: str
    at: float
    runs: int
    diverged: int
    measures: Mapping[str, Spread]


def summarise(
    rows: Sequence[Row], controllers: Iterable[str], at: Iterable[float]
) -> list[AuditPoint]:
    """The points of an audit, by controller, then time; rows in the order of their seeds."""
    times = tuple(at)
    return [
        _point([row for row in rows if row["controller"] == name and row["at"] == t], name, t)
        for name in controllers
        for t in times
    ]


def _point(rows: Sequence[Row], controller: str, at: float) -> AuditPoint:
    measures = {}
    for name in MEASURES:
        values = np.array([row[name] for row in rows if row[name] is not None], float)
        measures[name] = spread(values)
    diverged = sum(bool(row["diverged"]) for row in rows)
    return AuditPoint(controller, at, len(rows), diverged, measures)
