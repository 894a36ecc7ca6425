"""How runs went, in Markdown that the viewer can draw."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from dnnmso_mj.scenario import Scenario
from dnnmso_mj.trace import Trace

# Tried out: these and no others are known to be in the viewer's font.
_NOT_DRAWN = re.compile("[^\n -\u0148\u014a-\u017f\u0300-\u03de–—‘’“”…−‖⁻¹₀₁₂₃→⇒≤≥√∞≈≠∑∫]")

Metrics = Mapping[str, float | int | bool | None]


def drawable(text: str) -> str:
    """Text without the characters that would end a headless viewer; see `signals`."""
    return _NOT_DRAWN.sub("?", text)


def outcome(status: str, reason: str, duration: float) -> str:
    """Status and reason after so many seconds, in words."""
    return f"{duration:g} s: {status}: {reason}" if reason else f"{duration:g} s: {status}"


def summary(scenario: Scenario, how: str, metrics: Metrics) -> str:
    """One run: its title, its description, and a table of its metrics."""
    title = f"**{scenario.name}**, seed {scenario.seed}, {how}"
    table = _table(("metric", "value"), {name: [value] for name, value in metrics.items()})
    return drawable("\n\n".join(filter(None, [title, scenario.description, table])))


def comparison(names: Sequence[str], traces: Sequence[Trace]) -> str:
    """Several runs: their titles, numbered, and a table with a column for each."""
    titles = []
    for k, (name, trace) in enumerate(zip(names, traces, strict=True), start=1):
        info, scenario = trace.info, trace.scenario
        how = outcome(info.status, info.reason, len(trace) * scenario.dt)
        titles.append(f"{k}. **{name}**: {scenario.name}, seed {info.seed}, {how}")
    metrics = {name: None for trace in traces for name in trace.info.metrics}
    rows = {name: [trace.info.metrics.get(name) for trace in traces] for name in metrics}
    head = ("metric", *(str(k) for k in range(1, len(names) + 1)))
    return drawable("\n".join(titles) + "\n\n" + _table(head, rows))


def _table(head: Sequence[str], rows: Mapping[str, Sequence[float | int | bool | None]]) -> str:
    if not rows:
        return ""
    lines = [head, ["---"] * len(head)]
    lines += [[name, *map(_cell, values)] for name, values in rows.items()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(value: float | int | bool | None) -> str:
    if value is None:
        return "–"
    return ("yes" if value else "no") if isinstance(value, bool) else f"{value:.4g}"
