"""Sections of tables with a row a run: sweeps, by grid point, and comparisons, by controller."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from dnnmso_mj.figures.spreads import spread_figure
from dnnmso_mj.report.definitions import INTERVAL, METRICS, PAIRED
from dnnmso_mj.report.page import Block, Section, TableBlock, TextBlock
from dnnmso_mj.report.pictures import picture
from dnnmso_mj.report.words import facts_of, interval, listing, value
from dnnmso_mj.sweep.statistics import Spread, spread
from dnnmso_mj.sweep.summary import PointSummary, summarise_rows

Array = np.ndarray
Groups = Mapping[str, pa.Table]  # label -> its rows

HEADLINES = ("rmse_steady", "tau_peak", "tau_chatter")  # drawn, and compared pair by pair
GROUPS_DRAWN = 40
GROUPS_LISTED = 24  # each with a table of all its metrics
FAILURES_LISTED = 500


def sweep_section(table: pa.Table, provenance: Mapping[str, Any]) -> Section:
    """A table of `dnnmso sweep`."""
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
    blocks = [*_groups_blocks(groups), TextBlock("The scenario (of the first point)", scenario)]
    return Section(f"Sweep of {name}", facts, blocks, _present(table), [INTERVAL])


def comparison_section(table: pa.Table, provenance: Mapping[str, Any]) -> Section:
    """A table of `dnnmso compare`: rows are told apart by the column controller."""
    names = list(dict.fromkeys(table["controller"].to_pylist()))
    groups = {name: table.filter(pc.equal(table["controller"], name)) for name in names}
    definition = json.dumps(provenance.get("definition", {}), indent=1, ensure_ascii=False)
    blocks = [
        *_groups_blocks(groups),
        *_paired_blocks(groups),
        TextBlock("What was compared, in full", definition),
    ]
    title = f"Comparison on {provenance.get('scenario', 'a scenario')}"
    return Section(title, facts_of(provenance), blocks, _present(table), [INTERVAL, PAIRED])


def _short(keys: Sequence[str]) -> dict[str, str]:
    """Key paths -> their last parts, where those tell them apart."""
    last = {key: key.rpartition(".")[2] for key in keys}
    return last if len(set(last.values())) == len(last) else {key: key for key in keys}


def _groups_blocks(groups: Groups) -> list[Block]:
    summaries = {label: summarise_rows(rows, {}) for label, rows in groups.items()}
    blocks: list[Block] = [_headline_table(summaries)]
    drawn = dict(list(groups.items())[:GROUPS_DRAWN])
    more = f" The first {len(drawn)} of {len(groups)}." if len(drawn) < len(groups) else ""
    for name in HEADLINES:
        values = {label: _values(rows, name) for label, rows in drawn.items()}
        unit, meaning = METRICS[name]
        caption = f"{name}: {meaning} A point a run; box: quartiles; line: median.{more}"
        blocks.append(picture(caption, partial(spread_figure, values, f"{name} ({unit})")))
    for label, summary in list(summaries.items())[:GROUPS_LISTED]:
        blocks.append(_metrics_table(label, summary))
    return [*blocks, *_failures(summaries)]


def _headline_table(summaries: Mapping[str, PointSummary]) -> TableBlock:
    header = ["", "runs", "ok", "diverged", "failed", *(f"{name}" for name in HEADLINES)]
    rows = []
    for label, summary in summaries.items():
        counts = [summary.runs, summary.ok, summary.count("diverged"), summary.count("failed")]
        cells = [_with_interval(summary.metrics[name]) for name in HEADLINES]
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


def _failures(summaries: Mapping[str, PointSummary]) -> list[Block]:
    rows = [
        [label, str(failure.seed), failure.status, failure.reason]
        for label, summary in summaries.items()
        for failure in summary.failures
    ]
    if not rows:
        return [TableBlock("Runs that diverged or failed", ["none"], [])]
    more = f"The first {FAILURES_LISTED} of {len(rows)}." if len(rows) > FAILURES_LISTED else ""
    header = ["run", "seed", "status", "reason"]
    return [TableBlock("Runs that diverged or failed", header, rows[:FAILURES_LISTED], more)]


def _paired_blocks(groups: Groups) -> list[Block]:
    """Differences to the first controller, seed by seed."""
    base, *others = groups
    if not others:
        return []
    rows, blocks = [], []
    for name in HEADLINES:
        pairs = {label: _differences(groups[label], groups[base], name) for label in others}
        unit = METRICS[name][0]
        for label, differences in pairs.items():
            found = spread(differences)
            better = int(np.count_nonzero(differences < 0.0))
            ends = interval(found.ci_low, found.ci_high)
            won = f"{better} of {found.n}"
            rows.append([f"{name}, {label}", unit, str(found.n), value(found.median), ends, won])
        caption = f"{name}, seed by seed: each controller minus {base}; left of zero is less."
        label = f"difference of {name} ({unit})"
        blocks.append(picture(caption, partial(spread_figure, pairs, label, zero=True)))
    header = ["metric, controller", "unit", "pairs", "median", "95 % of median", "smaller"]
    return [TableBlock(f"Differences to {base}, seed by seed", header, rows), *blocks]


def _differences(rows: pa.Table, base: pa.Table, name: str) -> Array:
    """By ascending seed, of the seeds that both ended well with."""
    mine, theirs = _by_seed(rows, name), _by_seed(base, name)
    seeds = sorted(mine.keys() & theirs.keys())
    return np.array([mine[seed] - theirs[seed] for seed in seeds], dtype=float)


def _by_seed(rows: pa.Table, name: str) -> dict[int, float]:
    good = rows.filter(pc.equal(rows["status"], "ok")).select(["seed", name])
    return {row["seed"]: row[name] for row in good.to_pylist() if row[name] is not None}


def _values(rows: pa.Table, name: str) -> Array:
    good = rows.filter(pc.equal(rows["status"], "ok"))
    return np.asarray(good[name].drop_null(), dtype=float)


def _present(table: pa.Table) -> Sequence[str]:
    return [name for name in METRICS if name in table.column_names]


def _with_interval(found: Spread) -> str:
    if found.ci_low is None:
        return value(found.median)
    return f"{value(found.median)} [{interval(found.ci_low, found.ci_high)}]"
