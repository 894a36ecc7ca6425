"""The section of a table of `dnnmso margins`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import pyarrow as pa

from dnnmso_mj.figures.spreads import Interval, interval_figure
from dnnmso_mj.margins.cards import (
    Margin,
    Ranking,
    cell_text,
    interval_text,
    margins_of,
    mark,
    rank,
    unfound,
    value_text,
)
from dnnmso_mj.report.definitions import INTERVAL, MARGINS
from dnnmso_mj.report.page import Block, Section, TableBlock, TextBlock
from dnnmso_mj.report.pictures import picture
from dnnmso_mj.report.words import facts_of, interval

COUNTS = ("none", "below", "capped", "failed", "non_monotone")
FAILURES_LISTED = 500


def margins_section(table: pa.Table, provenance: Mapping[str, Any]) -> Section:
    """Who stands how much of what."""
    lines = margins_of(table, provenance)
    ranking = rank(lines, provenance)
    free = provenance["model_free"]
    facts = [
        *facts_of(provenance),
        ("controllers", ", ".join(provenance["controllers"])),
        ("without a model", ", ".join(free) or "none of them"),
        ("stands", f"not diverged, and rmse_steady ≤ {provenance['limit']:g} rad"),
        ("precision", f"{100 * provenance['search']['precision']:g} % of each margin"),
    ]
    scenarios = json.dumps(provenance["definition"]["scenarios"], indent=1, ensure_ascii=False)
    blocks = [
        _matrix(lines, ranking, provenance),
        *(_figure(name, lines, ranking, provenance) for name in provenance["rows"]),
        *(_card(name, lines, provenance) for name in provenance["controllers"]),
        _definitions(provenance),
        _failures(table),
        TextBlock("The scenarios", scenarios),
    ]
    title = f"Margins on {provenance['scenario']}"
    return Section(title, facts, blocks, ["rmse_steady"], [MARGINS, INTERVAL])


def _matrix(
    lines: Sequence[Margin], ranking: Mapping[str, Ranking], provenance: Mapping[str, Any]
) -> TableBlock:
    rows, free = provenance["rows"], provenance["model_free"]
    header = ["controller", *(_named(name, row) for name, row in rows.items())]
    body = []
    for name in provenance["controllers"]:
        label = name if name in free else f"{name} (has a model)"
        mine = [line for line in lines if line.controller == name]
        body.append([label, *(cell_text(line, rows[line.row], ranking) for line in mine)])
    note = "** the best median of those without a model; * its interval meets the best's."
    return TableBlock("Median margins", header, body, note)


def _figure(
    name: str,
    lines: Sequence[Margin],
    ranking: Mapping[str, Ranking],
    provenance: Mapping[str, Any],
) -> Block:
    row = provenance["rows"][name]
    bars = []
    for line in lines:
        if line.row == name:
            found, best = line.spread, mark(line, ranking)
            text = line.unused or f"{value_text(found.median, row)} {best}"
            bars.append(
                Interval(
                    line.controller, found.median, found.ci_low, found.ci_high, text, best != ""
                )
            )
    ends = (row["easiest"], row["cap"])
    caption = (
        f"{name}: {row['what']}. Further right is better. Dot: median; bar: its 95 % interval."
    )
    return picture(caption, partial(interval_figure, bars, _named(name, row), ends, title=name))


def _card(name: str, lines: Sequence[Margin], provenance: Mapping[str, Any]) -> TableBlock:
    body = []
    for line in lines:
        if line.controller != name:
            continue
        row = provenance["rows"][line.row]
        if line.unused:
            body.append([_named(line.row, row), line.unused, *[""] * (2 + len(COUNTS))])
            continue
        counts = [str(getattr(line, key)) for key in COUNTS]
        median = value_text(line.spread.median, row)
        ends = interval_text(line, row)
        body.append([_named(line.row, row), median, ends, str(line.spread.n), *counts])
    names = [key.replace("_", "-") for key in COUNTS]
    header = ["row", "median", "95 % of median", "seeds", *names]
    return TableBlock(f"Margin card of {name}", header, body)


def _definitions(provenance: Mapping[str, Any]) -> TableBlock:
    body = [
        [name, row["unit"], interval(row["easiest"], row["cap"]), row["better"], row["what"]]
        for name, row in provenance["rows"].items()
    ]
    return TableBlock("What was searched", ["row", "unit", "from … to", "better", "what"], body)


def _failures(table: pa.Table) -> TableBlock:
    found = unfound(table)
    header = ["controller", "seed", "rows", "status", "reason"]
    body = [
        [line.controller, str(line.seed), ", ".join(line.rows), line.status, line.reason]
        for line in found[:FAILURES_LISTED]
    ]
    more = f"The first {FAILURES_LISTED} of {len(found)}." if len(found) > FAILURES_LISTED else ""
    return TableBlock("Searches without a margin", header if body else ["none"], body, more)


def _named(name: str, row: Mapping[str, Any]) -> str:
    return f"{name} ({row['unit']})" if row["unit"] else name
