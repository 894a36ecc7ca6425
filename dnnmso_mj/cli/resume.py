"""`dnnmso resume` and `diff`: go on from any tick of a log; say in what two logs differ."""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dnnmso_mj.cli.run import can_draw, draw, print_summary, tell
from dnnmso_mj.cli.shared import (
    DIVERGED,
    Json,
    Log,
    Overrides,
    Trust,
    near,
    print_table,
    progress_bar,
)
from dnnmso_mj.errors import RunInterrupted, UnloggedRunError
from dnnmso_mj.wording import show

if TYPE_CHECKING:
    from dnnmso_mj.difference import Difference, Place
    from dnnmso_mj.resume import Resumed

DIFFERENT = 1
MOST_TOLD = 20  # events, or snapshots


def resume(
    log: Log,
    at: Annotated[float, typer.Option(help="When to go on (s); at the nearest tick.")],
    overrides: Overrides = None,
    out: Annotated[
        Path | None, typer.Option(help="The new log; default LOG-from-AT.mcap beside the log.")
    ] = None,
    force: Annotated[bool, typer.Option(help="Replace an existing log.")] = False,
    plot: Annotated[bool, typer.Option(help="Draw the figures beside the log.")] = True,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Go on from any tick of a log: bit for bit, or with something changed."""
    from dnnmso_mj.resume import resume as resume_log

    plot = plot and can_draw()
    sets = overrides or []
    try:
        with progress_bar(log.stem, None) as progress:
            done = resume_log(log, at, sets, out, force=force, trust=trust, progress=progress)
    except RunInterrupted as stop:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # all that is left is to say what was run
        if stop.ticks or as_json:
            tell(stop.run, [], as_json=as_json, real_time=False)
        raise KeyboardInterrupt(f"log: {near(stop.log)} ({stop.ticks} ticks)") from stop
    except UnloggedRunError as error:
        tell(error.run, [], as_json=as_json, real_time=False)
        raise
    figures, undrawn = draw(done.run) if plot else ([], None)
    _tell(done, log, sets, figures, as_json=as_json)
    info = done.run.info
    if undrawn is not None:
        raise undrawn
    if info.status == "diverged":
        print(f"diverged: {info.reason}", file=sys.stderr)
        raise typer.Exit(DIVERGED)


def _tell(
    done: Resumed, source: Path, sets: list[str], figures: list[Path], *, as_json: bool
) -> None:
    scenario, info = done.run.scenario, done.run.info
    t = done.tick * scenario.dt
    if as_json:
        print(json.dumps({
            "status": info.status,
            "reason": info.reason,
            "scenario": scenario.name,
            "source": str(source),
            "at": t,
            "checked_ticks": done.checked,
            "changed": sets,
            "log": str(done.run.log),
            "figures": [str(figure) for figure in figures],
            "seed": info.seed,
            "wall_s": info.wall_s,
            "metrics": dict(info.metrics),
        }))  # fmt: skip
        return
    print_summary(done.run, figures, since=done.tick)
    print(
        f"resumed  {near(source)} at {t:g} s; the {done.checked} ticks before were computed again"
    )
    if done.told:
        print(f"branch   {done.told}")


def diff(
    log: Log,
    other: Log,
    as_json: Json = False,
) -> None:
    """Say where two logs first differ, and by how much; exit status 1 if they do."""
    from dnnmso_mj.difference import difference

    found = difference(log, other)
    if as_json:
        print(json.dumps(found.plain()))
    else:
        _print_difference(found)
    if not found.equal:
        raise typer.Exit(DIFFERENT)


def _print_difference(found: Difference) -> None:
    from rich.table import Table

    if found.columns:
        first = found.columns[0]
        at = first.first
        print(f"first difference: tick {at.tick}, t = {at.t:g} s: {_told(first.name, at)}")
        table = Table("column", "differs from", "by", "at most", "at")
        for column in found.columns:
            begin, most = column.first, column.largest
            cells = (f"{begin.t:g} s", f"{begin.difference:.3g}", f"{most.difference:.3g}")
            table.add_row(column.name, *cells, f"{most.t:g} s, entry {most.entry}")
        print_table(table)
    elif found.ticks[0] == found.ticks[1]:
        print(f"all {found.ticks[0]} ticks are the same, bit for bit")
    else:
        print(f"the {min(found.ticks)} ticks that both have are the same, bit for bit")
    if found.ticks[0] != found.ticks[1]:
        print(f"ticks: {found.ticks[0]}, and {found.ticks[1]}")
    for line in _other_differences(found):
        print(line)


def _other_differences(found: Difference) -> Iterator[str]:
    pairs = {**found.widths, **found.scenario, **({"status": found.status} if found.status else {})}
    for name, (one, other) in pairs.items():
        yield f"{name}: {show(one)}, and {show(other)}"
    for which, events in zip(("first", "second"), found.events, strict=True):
        yield from (f"event of the {which} log alone: {event}" for event in events[:MOST_TOLD])
        if len(events) > MOST_TOLD:
            yield f"and {len(events) - MOST_TOLD} more"
    yield from (f"snapshot {text}" for text in found.snapshots[:MOST_TOLD])
    if len(found.snapshots) > MOST_TOLD:
        yield f"and {len(found.snapshots) - MOST_TOLD} more in snapshots"
    if found.files:
        yield f"files in the log: {', '.join(found.files)}"
    apart = [column.name for column in found.clocked]
    if apart:
        yield f"not counted, of the wall clock: {', '.join(apart)}"
    for name, (one, other) in found.versions.items():
        yield f"not counted: made with {name} {one or 'unknown'}, and {other or 'unknown'}"


def _told(name: str, at: Place) -> str:
    return f"{name}[{at.entry}] = {at.values[0]!r}, and {at.values[1]!r}, by {at.difference:.3g}"
