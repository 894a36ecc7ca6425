"""The section of a table of `dnnmso sweep`, point by point."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from dnnmso_mj.figures.spreads import spread_figure
from dnnmso_mj.report.definitions import INTERVAL, METRICS, SWEPT
from dnnmso_mj.report.page import Block, Section, TableBlock, TextBlock
from dnnmso_mj.report.pictures import picture
from dnnmso_mj.report.words import facts_of, interval, listing, value, with_interval
from dnnmso_mj.sweep.summary import Failure, PointSummary, summarise_rows

Array = np.ndarray
Groups = Mapping[str, pa.Table]  # label -> its rows

HEADLINES = ("rmse_steady", "tau_peak", "tau_chatter")  # drawn
GROUPS_DRAWN = 40
GROUPS_LISTED = 24  # each with a table of all its metrics
FAILURES_LISTED = 500


def sweep_section(table: pa.Table, provenance: Mapping[str, Any]) -> Section:
    """What came out at each point of the grid."""
    points = provenance["definition"]["points"]
    size = len(table) // len(points)
    parameters = [point["parameters"] for point in points]
    varied = [key for key in parameters[0] if len({json.dumps(p[key]) for p in parameters}) > 1]
    short = _short(varied)
    groups = {}
    for k, here in enumerate(parameters):
        label = listing({short[key]: here[key] for key in varied}) or points[0]["scenario"]["name"]
        groups[label] = table.slice(k * size, size)
    facts = [
        *facts_of(provenance),
        ("engine", str(provenance["engine"])),
        *((key, str(here)) for key, here in parameters[0].items() if key not in varied),
        *((key, "varied") for key in varied),
    ]
    name = points[0]["scenario"]["name"]
    scenario = json.dumps(points[0]["scenario"], indent=1, ensure_ascii=False)
    summaries = {label: summarise_rows(rows, {}) for label, rows in groups.items()}
    blocks = [
        _headline_table(summaries),
        *spread_blocks(groups),
        *(_metrics_table(*item) for item in list(summaries.items())[:GROUPS_LISTED]),
        failures_block(summaries),
        TextBlock("The scenario (of the first point)", scenario),
    ]
    return Section(f"Sweep of {name}", facts, blocks, present(table), [INTERVAL, SWEPT])


def _short(keys: Sequence[str]) -> dict[str, str]:
    """Key paths -> their last parts, where those tell them apart."""
    last = {key: key.rpartition(".")[2] for key in keys}
    return last if len(set(last.values())) == len(last) else {key: key for key in keys}


def spread_blocks(groups: Groups) -> list[Block]:
    """A picture of each of `HEADLINES`, over the runs that ended well."""
    drawn = dict(list(groups.items())[:GROUPS_DRAWN])
    more = f" The first {len(drawn)} of {len(groups)}." if len(drawn) < len(groups) else ""
    blocks: list[Block] = []
    for name in HEADLINES:
        values = {label: _values(rows, name) for label, rows in drawn.items()}
        unit, meaning = METRICS[name]
        caption = f"{name}: {meaning} A point a run; box: quartiles; line: median.{more}"
        blocks.append(picture(caption, partial(spread_figure, values, f"{name} ({unit})")))
    return blocks


def _headline_table(summaries: Mapping[str, PointSummary]) -> TableBlock:
    header = ["", "runs", "ok", "diverged", "failed", *HEADLINES]
    rows = []
    for label, summary in summaries.items():
        counts = [summary.runs, summary.ok, summary.count("diverged"), summary.count("failed")]
        cells = [with_interval(summary.metrics[name]) for name in HEADLINES]
        rows.append([label, *map(str, counts), *cells])
    return TableBlock("Medians over seeds [95 % interval]", header, rows)


def _metrics_table(label: str, summary: PointSummary) -> TableBlock:
    header = ["metric", "unit", "runs", "median", "quartiles", "95 % of median"]
    rows = [
        [
            name,
            METRICS[name][0] if name in METRICS else "",
            str(found.n),
            value(found.median),
            interval(found.q25, found.q75),
            interval(found.ci_low, found.ci_high),
        ]
        for name, found in summary.metrics.items()
    ]
    return TableBlock(f"{label}: {summary.ok} of {summary.runs} runs ok", header, rows)


class HasFailures(Protocol):
    """Whatever knows of runs that did not end well."""

    @property
    def failures(self) -> Sequence[Failure]:
        """All of them."""


def failures_block(groups: Mapping[str, HasFailures]) -> TableBlock:
    """Runs that did not end well, each with its seed and reason."""
    rows = [
        [label, str(failure.seed), failure.status, failure.reason]
        for label, group in groups.items()
        for failure in group.failures
    ]
    if not rows:
        return TableBlock("Runs that diverged or failed", ["none"], [])
    more = f"The first {FAILURES_LISTED} of {len(rows)}." if len(rows) > FAILURES_LISTED else ""
    header = ["run", "seed", "status", "reason"]
    return TableBlock("Runs that diverged or failed", header, rows[:FAILURES_LISTED], more)


def _values(rows: pa.Table, name: str) -> Array:
    good = rows.filter(pc.equal(rows["status"], "ok"))
    return np.asarray(good[name].drop_null(), dtype=float)


def present(table: pa.Table) -> Sequence[str]:
    """Names of the metrics that are columns of a table."""
    return [name for name in METRICS if name in table.column_names]
