"""An audit from its plan to its findings: every controller with every seed, on all cores."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass

from dnnmso_mj.audit.plan import AuditPlan
from dnnmso_mj.audit.portrait import Portrait
from dnnmso_mj.audit.subject import Findings, Questions, Row, Subject, examine
from dnnmso_mj.audit.summary import AuditPoint, summarise
from dnnmso_mj.sweep.local import LocalEngine
from dnnmso_mj.sweep.task import failed_row


@dataclass(frozen=True)
class Audit:
    """A finished audit.

    Args:
        plan: what was asked.
        rows: one for each controller, seed and freeze time, in this order.
        points: their summary.
        portraits: of each controller with the first seed, at the last freeze time, unless its run
            diverged while it was learning.
        failures: controller, seed and reason of every examination that broke off.
        wall_s: (s).
    """

    plan: AuditPlan
    rows: tuple[Row, ...]
    points: tuple[AuditPoint, ...]
    portraits: tuple[Portrait, ...]
    failures: tuple[Row, ...]
    wall_s: float


@dataclass(frozen=True)
class Examination:
    """The work of one process: one controller with some seeds.

    Args:
        point: its number.
        subject, questions: see there.
        seeds: one row each.
        drawn: the seed whose portrait is wanted.
    """

    point: int
    subject: Subject
    questions: Questions
    seeds: tuple[int, ...]
    drawn: int

    def __call__(self) -> Iterator[Row]:
        """Examine, and yield each seed's findings; an error is a row like any other."""
        for seed in self.seeds:
            try:
                found = examine(self.subject, self.questions, seed, draw=seed == self.drawn)
                yield {"point": self.point, "seed": seed, "status": "ok", "findings": found}
            except Exception as error:
                yield failed_row(self.point, seed, f"{type(error).__name__}: {error}")


def run_audit(
    plan: AuditPlan, jobs: int | None = None, progress: Callable[[int], None] | None = None
) -> Audit:
    """Examine every controller with every seed; `jobs` at once, by default one a core."""
    started = time.perf_counter()
    work = [
        Examination(k, subject, plan.questions, (seed,), plan.seeds[0])
        for k, subject in enumerate(plan.subjects)
        for seed in plan.seeds
    ]
    found: dict[tuple[int, int], Row] = {}
    with closing(LocalEngine(jobs).rows(work)) as rows:
        for row in rows:
            found[row["point"], row["seed"]] = row
            if progress is not None:
                progress(1)
    return gather(plan, [found[key] for key in sorted(found)], time.perf_counter() - started)


def gather(plan: AuditPlan, done: Sequence[Row], wall_s: float) -> Audit:
    """The audit that finished examinations make, given by controller, then seed."""
    names = [subject.name for subject in plan.subjects]
    findings: list[Findings] = [row["findings"] for row in done if row["status"] == "ok"]
    rows = tuple(row for found in findings for row in found.rows)
    return Audit(
        plan=plan,
        rows=rows,
        points=tuple(summarise(rows, names, plan.questions.at)),
        portraits=tuple(found.portrait for found in findings if found.portrait is not None),
        failures=tuple(
            {"controller": names[row["point"]], "seed": row["seed"], "reason": row["reason"]}
            for row in done
            if row["status"] != "ok"
        ),
        wall_s=wall_s,
    )
