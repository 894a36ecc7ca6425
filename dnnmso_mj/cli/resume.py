"""`dnnmso resume`: go on from any tick of a log, as it was or with something changed."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from dnnmso_mj.cli.run import draw, print_summary
from dnnmso_mj.cli.shared import DIVERGED, Json, Log, Overrides, near, progress_bar
from dnnmso_mj.errors import RunInterrupted


def resume(
    log: Log,
    at: Annotated[float, typer.Option(help="When to go on (s); at the nearest tick.")],
    overrides: Overrides = None,
    out: Annotated[
        Path | None, typer.Option(help="The new log; default LOG-from-AT.mcap beside the log.")
    ] = None,
    force: Annotated[bool, typer.Option(help="Replace an existing log.")] = False,
    plot: Annotated[bool, typer.Option(help="Draw the figures beside the log.")] = True,
    as_json: Json = False,
) -> None:
    """Go on from any tick of a log: bit for bit, or with something changed."""
    from dnnmso_mj.resume import resume as resume_log

    sets = overrides or []
    try:
        with progress_bar(log.stem, None) as progress:
            done = resume_log(log, at, sets, out, force=force, progress=progress)
    except RunInterrupted as stop:
        raise KeyboardInterrupt(f"log: {near(stop.log)} ({stop.ticks} ticks)") from stop
    trace, info = done.run.trace, done.run.trace.info
    figures, undrawn = draw(done.run) if plot else ([], None)
    t = done.tick * trace.scenario.dt
    if as_json:
        print(json.dumps({
            "status": info.status,
            "reason": info.reason,
            "scenario": trace.scenario.name,
            "source": str(log),
            "at": t,
            "checked_ticks": done.checked,
            "branched": done.branched,
            "log": str(done.run.log),
            "figures": [str(figure) for figure in figures],
            "seed": info.seed,
            "wall_s": info.wall_s,
            "metrics": dict(info.metrics),
        }))  # fmt: skip
    else:
        print_summary(trace, done.run.log, figures)
        print(f"resumed  {near(log)} at {t:g} s; {done.checked} ticks before that are as computed")
        if done.branched:
            print(f"changed  {done.branched}")
    if undrawn is not None:
        raise undrawn
    if info.status == "diverged":
        print(f"diverged: {info.reason}", file=sys.stderr)
        raise typer.Exit(DIVERGED)
