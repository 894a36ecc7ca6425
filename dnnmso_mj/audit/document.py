"""All numbers of an audit as JSON."""

from __future__ import annotations

from typing import Any

from dnnmso_mj.audit.frozen import window
from dnnmso_mj.audit.run import Audit
from dnnmso_mj.audit.unseen import SETTLING, SPAN


def document(audit: Audit) -> dict[str, Any]:
    """Questions, summary and every row; the names are a contract with `--json`."""
    questions, scenario = audit.plan.questions, audit.plan.subjects[0].scenario
    region = questions.region
    return {
        "scenario": audit.plan.name,
        "at": questions.at,
        "seeds": audit.plan.seeds,
        "window_s": window(scenario),
        "unseen_s": SPAN,
        "unseen_settling_s": SETTLING,
        "region": {"centre": region.centre.tolist(), "half": region.half.tolist()},
        "unseen": [
            {
                "name": one.name,
                "inside": one.inside,
                "reference": one.reference.model_dump(mode="json"),
            }
            for one in questions.unseen
        ],
        "points": [
            {
                **{key: value for key, value in vars(point).items() if key != "measures"},
                "measures": {name: vars(value) for name, value in point.measures.items()},
            }
            for point in audit.points
        ],
        "rows": audit.rows,
        "failures": audit.failures,
        "wall_s": audit.wall_s,
    }
