"""The section of a table of `dnnmso compare`, controller by controller and pair by pair."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from dnnmso_mj.comparison.pairing import Pairing, log_ratios
from dnnmso_mj.comparison.plan import COLUMN
from dnnmso_mj.comparison.summary import RANKED_BY, Comparison, judged, summarise
from dnnmso_mj.figures.spreads import spread_figure
from dnnmso_mj.report.definitions import COMPARED, INTERVAL, METRICS
from dnnmso_mj.report.page import Block, Section, TableBlock, TextBlock
from dnnmso_mj.report.pictures import picture
from dnnmso_mj.report.runs import failures_block, present, spread_blocks
from dnnmso_mj.report.words import facts_of, interval, value, with_interval


def comparison_section(table: pa.Table, provenance: Mapping[str, Any]) -> Section:
    """Who is better than whom, and how sure that is."""
    found = summarise(table)
    names = [point["parameters"][COLUMN] for point in provenance["definition"]["points"]]
    groups = {name: table.filter(pc.equal(table[COLUMN], name)) for name in names}
    scenarios = {
        point["parameters"][COLUMN]: point["scenario"]
        for point in provenance["definition"]["points"]
    }
    blocks: list[Block] = [
        _ranking(found),
        *_pairs(found, groups),
        *spread_blocks(groups),
        failures_block({standing.controller: standing for standing in found.standings}),
        TextBlock("The scenarios", json.dumps(scenarios, indent=1, ensure_ascii=False)),
    ]
    facts = [*facts_of(provenance), ("controllers", ", ".join(names))]
    title = f"Comparison on {provenance['scenario']}"
    return Section(title, facts, blocks, present(table), [INTERVAL, COMPARED])


def _ranking(found: Comparison) -> TableBlock:
    metrics = list(found.standings[0].metrics)
    units = [f"{name} ({METRICS[name][0]})" for name in metrics]
    rows = [
        [
            f"{rank}. {standing.controller}",
            str(standing.runs),
            str(standing.count("diverged")),
            str(standing.count("failed")),
            *(with_interval(standing.metrics[name]) for name in metrics),
        ]
        for rank, standing in enumerate(found.standings, start=1)
    ]
    header = ["controller", "runs", "diverged", "failed", *units]
    return TableBlock(f"Ranking by the median of {RANKED_BY} [95 % interval]", header, rows)


def _pairs(found: Comparison, groups: Mapping[str, pa.Table]) -> list[Block]:
    """The table of pairs, and a picture of their ratios."""
    if not found.pairings:
        return []
    base = found.pairings[0].against
    header = ["controller", "ratio", "95 % of ratio", "wins", "losses", "ties", "p", "p (Holm)"]
    rows = [_pair_cells(pairing) for pairing in found.pairings]
    others = judged(groups[base], RANKED_BY)
    ratios = {}
    for pairing in found.pairings:
        logs = log_ratios(judged(groups[pairing.controller], RANKED_BY), others)
        ratios[pairing.controller] = np.exp(logs[np.isfinite(logs)])
    label = f"{RANKED_BY} over that of {base}, seed by seed"
    caption = f"{label}: left of 1 is better than {base}. Seeds at which one failed are not drawn."
    draw = partial(spread_figure, ratios, label, mark=1.0)
    return [TableBlock(f"{RANKED_BY} against {base}", header, rows), picture(caption, draw)]


def _pair_cells(pairing: Pairing) -> list[str]:
    spread = pairing.log_ratio
    counts = [str(count) for count in (pairing.wins, pairing.losses, pairing.ties)]
    ends = interval(_ratio(spread.ci_low), _ratio(spread.ci_high))
    median = value(_ratio(spread.median))
    return [pairing.controller, median, ends, *counts, f"{pairing.p:.2g}", f"{pairing.p_holm:.2g}"]


def _ratio(log_ratio: float | None) -> float | None:
    """What a log ratio is the logarithm of."""
    if log_ratio is None:
        return None
    return math.inf if log_ratio == math.inf else math.exp(log_ratio)
