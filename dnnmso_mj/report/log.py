"""The section of a run's log."""

from __future__ import annotations

import json
from pathlib import Path

from dnnmso_mj.figures.drawing import house_style
from dnnmso_mj.plots import png_bytes, run_figures
from dnnmso_mj.reading import log_info, read_trace
from dnnmso_mj.report.definitions import METRICS
from dnnmso_mj.report.page import Block, FigureBlock, Section, TableBlock, TextBlock
from dnnmso_mj.report.words import listing, value

CAPTIONS = {
    "tracking": "Joint angles over their references.",
    "error": "Tracking errors, and the worst joint on a logarithmic axis.",
    "torque": "Torques that were applied, with the actuators' limits.",
    "learning": "The network's learning.",
    "theory": "What the theory promises, and what was.",
}


def log_section(path: Path) -> Section:
    """Metrics, events and figures of one run.

    Raises:
        LogError: no log, or one without a tick.
    """
    info, trace = log_info(path), read_trace(path)
    facts = [
        ("scenario", info.scenario),
        ("seed", str(info.seed)),
        ("status", f"{info.status} {info.reason}".strip()),
        ("ticks", f"{info.ticks} ({info.duration:g} s)"),
        ("software", listing(info.versions)),
        ("commit", info.git_commit or "not known"),
        ("command", f"dnnmso info {path.name}"),
    ]
    metrics = [
        [name, METRICS[name][0] if name in METRICS else "", value(found)]
        for name, found in info.metrics.items()
    ]
    events = [[f"{event.t:.3f}", event.level, event.message] for event in info.events]
    with house_style():
        pictures = {name: png_bytes(figure) for name, figure in run_figures(trace).items()}
    scenario = json.dumps(trace.scenario.model_dump(mode="json"), indent=1, ensure_ascii=False)
    blocks: list[Block] = [
        TableBlock("Metrics", ["metric", "unit", "value"], metrics),
        *(FigureBlock(CAPTIONS[name], png) for name, png in pictures.items()),
        TableBlock("Events", ["t (s)", "level", "message"] if events else ["none"], events),
        TextBlock("The scenario", scenario),
    ]
    return Section(f"Run of {info.scenario}, seed {info.seed}", facts, blocks, list(info.metrics))
