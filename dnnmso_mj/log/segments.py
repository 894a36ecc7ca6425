"""A run that was resumed: which scenario was in force from which tick, as records of its log."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dnnmso_mj.log.format import MODEL
from dnnmso_mj.log.json_texts import read_json
from dnnmso_mj.scenario import Scenario

SEGMENTS, RESUMED = "segments", "resumed"  # metadata records


@dataclass(frozen=True)
class Segment:
    """A stretch of a run under one scenario.

    Args:
        first: its first tick.
        scenario: in force from then on.
        model: the attachment that holds its MJCF.
        told: the event that says how it began; "" of the first.
    """

    first: int
    scenario: Scenario
    model: str = MODEL
    told: str = ""


def segments_record(segments: Sequence[Segment]) -> dict[str, str]:
    """The metadata record of all segments."""
    rows = [vars(part) | {"scenario": part.scenario.model_dump(mode="json")} for part in segments]
    return {"json": json.dumps(rows)}


def read_segments(records: Mapping[str, Mapping[str, str]], scenario: Scenario) -> list[Segment]:
    """The segments of a log, one at least, in order.

    Args:
        records: its metadata.
        scenario: its own.

    Raises:
        ValueError: the record is damaged, or of another version of this package.
    """
    if SEGMENTS not in records:
        return [Segment(0, scenario)]
    try:
        segments = [
            Segment(
                first=int(row["first"]),
                scenario=Scenario.model_validate_json(json.dumps(row["scenario"])),
                model=str(row["model"]),
                told=str(row["told"]),
            )
            for row in read_json(records[SEGMENTS]["json"])
        ]
    except (ValueError, KeyError, TypeError, OverflowError) as error:  # pydantic's is a ValueError
        raise ValueError(f"its record {SEGMENTS!r} is not one of this version") from error
    firsts = [part.first for part in segments]
    fitting = all(
        (s.scenario.dt, s.scenario.n_joints) == (scenario.dt, scenario.n_joints) for s in segments
    )
    if not fitting or firsts[:1] != [0] or firsts != sorted(set(firsts)):
        raise ValueError(f"its record {SEGMENTS!r} has parts of another robot, or out of order")
    return segments
