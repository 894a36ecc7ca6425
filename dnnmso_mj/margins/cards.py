"""What a table of margins says: a card a controller, and who is best at what.

A table is read by its own metadata alone, so that one of another version says what it said then.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from dnnmso_mj.sweep.statistics import Spread, spread

TOLERANCE = 1e-9  # relative: a value at the cap is the cap


@dataclass(frozen=True)
class Margin:
    """One line of a card: a controller's margin of one row over its seeds.

    Args:
        controller, row: their names.
        unused: why there is none to search; "" where there is.
        spread: over the seeds that were searched; one without a margin is infinitely bad. n is 0
            where there was none to search.
        none: seeds that fail without any of it.
        below: seeds that fail at the smallest value that is probed.
        capped: seeds that stand the largest.
        failed: seeds whose search raised or whose process died; not in the spread.
        non_monotone: seeds that fail somewhere below their margin.
    """

    controller: str
    row: str
    unused: str
    spread: Spread
    none: int
    below: int
    capped: int
    failed: int
    non_monotone: int


@dataclass(frozen=True)
class Ranking:
    """Model-free controllers with the best median, and those whose interval meets the best's."""

    best: tuple[str, ...]
    within: tuple[str, ...]


@dataclass(frozen=True)
class Unfound:
    """A seed without a margin in some rows, all for the same reason.

    Args:
        controller, seed, status, reason: as in the table; the status is none or failed.
        rows: names.
    """

    controller: str
    rows: tuple[str, ...]
    seed: int
    status: str
    reason: str


def unfound(table: pa.Table) -> list[Unfound]:
    """Searches that failed, or whose controller fails without any imperfection."""
    rows: dict[tuple[str, int, str, str], list[str]] = {}
    for line in table.to_pylist():
        if line["status"] in {"none", "failed"}:
            key = (line["controller"], line["seed"], line["status"], line["reason"])
            rows.setdefault(key, []).append(line["row"])
    return [
        Unfound(controller, tuple(names), seed, status, reason)
        for (controller, seed, status, reason), names in rows.items()
    ]


def margins_of(table: pa.Table, provenance: Mapping[str, Any]) -> list[Margin]:
    """Every line of every card, by controller, then row."""
    return [
        _margin(table, controller, row, provenance["rows"][row])
        for controller in provenance["controllers"]
        for row in provenance["rows"]
    ]


def rank(margins: Sequence[Margin], provenance: Mapping[str, Any]) -> dict[str, Ranking]:
    """For each row, the best model-free controllers; empty where none of them has a margin."""
    free = set(provenance["model_free"])
    rankings = {}
    for name, row in provenance["rows"].items():
        lines = [
            line
            for line in margins
            if line.row == name
            and line.controller in free
            and line.spread.median is not None
            and not is_none(line.spread.median, row)
        ]
        rankings[name] = _ranking(lines, 1.0 if row["better"] == "larger" else -1.0)
    return rankings


def is_none(value: float, row: Mapping[str, Any]) -> bool:
    """Whether a value is worse than the smallest that is probed."""
    easiest: float = row["easiest"]
    return value < easiest if row["better"] == "larger" else value > easiest


def is_capped(value: float, row: Mapping[str, Any]) -> bool:
    """Whether a value is where the search ended, so that the margin may be any better."""
    cap: float = row["cap"]
    if row["better"] == "larger":
        return value >= cap * (1.0 - TOLERANCE)
    return value <= cap * (1.0 + TOLERANCE)


def value_text(value: float | None, row: Mapping[str, Any]) -> str:
    """A value of a row for people: "0.021", "> 51.2" at the cap, "none"."""
    if value is None:
        return "–"
    if is_none(value, row):
        return "none"
    if is_capped(value, row):
        return f"{'>' if row['better'] == 'larger' else '<'} {_digits(row['cap'])}"
    return _digits(value)


def _digits(value: float) -> str:
    """Three digits: the search is no finer."""
    return f"{value:.0f}" if 100.0 <= value < 1e5 else f"{value:.3g}"


def interval_text(margin: Margin, row: Mapping[str, Any]) -> str:
    """The 95 % interval of the median for people."""
    if margin.spread.n == 0:
        return ""
    if margin.spread.ci_low is None:
        return "too few seeds"
    ends = [value_text(end, row) for end in (margin.spread.ci_low, margin.spread.ci_high)]
    return ends[0] if ends[0] == ends[1] else f"{ends[0]} … {ends[1]}"


def mark(margin: Margin, ranking: Mapping[str, Ranking]) -> str:
    """ "**" for the best, "*" for one whose interval meets the best's, else ""."""
    found = ranking[margin.row]
    return "**" if margin.controller in found.best else "*" * (margin.controller in found.within)


def cell_text(margin: Margin, row: Mapping[str, Any], ranking: Mapping[str, Ranking]) -> str:
    """A margin as an entry of the matrix: the median and its mark; "–" where there is none."""
    median = value_text(margin.spread.median, row)
    return f"{median} {mark(margin, ranking)}".rstrip()


def _margin(table: pa.Table, controller: str, row: str, definition: Mapping[str, Any]) -> Margin:
    mine = pc.and_(pc.equal(table["controller"], controller), pc.equal(table["row"], row))
    rows = table.filter(mine).to_pylist()
    searched = [line for line in rows if line["status"] not in {"unused", "failed"}]
    worst = -math.inf if definition["better"] == "larger" else math.inf
    values = [worst if line["margin"] is None else line["margin"] for line in searched]
    counts = {
        status: sum(line["status"] == status for line in rows)
        for status in ("none", "below", "capped", "failed")
    }
    unused = [line["reason"] for line in rows if line["status"] == "unused"]
    return Margin(
        controller=controller,
        row=row,
        unused=unused[0] if unused else "",
        spread=spread(np.array(values, dtype=float)),
        non_monotone=sum(bool(line["non_monotone"]) for line in searched),
        **counts,
    )


def _ranking(lines: Sequence[Margin], sign: float) -> Ranking:
    if not lines:
        return Ranking((), ())
    top = max(sign * (line.spread.median or 0.0) for line in lines)
    best = [line for line in lines if sign * (line.spread.median or 0.0) == top]
    low, high = _interval(best[0])
    names = tuple(line.controller for line in best)
    within = tuple(
        line.controller
        for line in lines
        if line not in best and _interval(line)[1] >= low and _interval(line)[0] <= high
    )
    return Ranking(names, within)


def _interval(line: Margin) -> tuple[float, float]:
    """The median's interval; with too few seeds for one, the median alone."""
    found = line.spread
    middle = found.median or 0.0
    low = middle if found.ci_low is None else found.ci_low
    return low, middle if found.ci_high is None else found.ci_high
