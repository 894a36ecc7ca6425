"""A run that was resumed: which scenario was in force from which tick, as records of its log."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pydantic import ValidationError

from dnnmso_mj.log.format import MODEL
from dnnmso_mj.scenario import Scenario

SEGMENTS, RESUMED = "segments", "resumed"  # metadata records


@dataclass(frozen=True)
class Segment:
    """A stretch of a run under one scenario.

    Args:
        first: its first tick.
        scenario: in force from then on.
        model: the attachment that holds its MJCF.
    """

    first: int
    scenario: Scenario
    model: str = MODEL


def segments_record(earlier: Sequence[Segment], first: int) -> dict[str, str]:
    """All segments but the last, whose scenario is the log's own, and where that begins."""
    rows = [
        {"first": part.first, "model": part.model, "scenario": part.scenario.model_dump_json()}
        for part in earlier
    ]
    return {"earlier": json.dumps(rows), "first": str(first)}


def read_segments(records: Mapping[str, Mapping[str, str]], scenario: Scenario) -> list[Segment]:
    """The segments of a log, one at least, in order.

    Args:
        records: its metadata.
        scenario: its own.

    Raises:
        ValueError: the record is damaged, or of another version of this package.
    """
    record = records.get(SEGMENTS, {"earlier": "[]", "first": "0"})
    try:
        earlier = [
            Segment(int(row["first"]), Scenario.model_validate_json(row["scenario"]), row["model"])
            for row in json.loads(record["earlier"])
        ]
        return [*earlier, Segment(int(record["first"]), scenario)]
    except (ValidationError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"its record {SEGMENTS!r} is not one of this version") from error
