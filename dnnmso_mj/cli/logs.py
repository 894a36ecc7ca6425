"""`dnnmso plot`, `replay`, `info` and `recover`: what is done with logs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from dnnmso_mj.cli.live import LOCAL, Bind, Port, require_page
from dnnmso_mj.cli.shared import Json, Log, Logs, listing, number, print_table, working
from dnnmso_mj.extras import require


def plot(
    logs: Logs,
    out: Annotated[Path | None, typer.Option(help="Folder; default beside the first log.")] = None,
) -> None:
    """Draw the paper's figures and the theory from logs; several are compared."""
    require("plot", "dnnmso plot")
    from dnnmso_mj.logged import read_drawn
    from dnnmso_mj.plots import save_comparison, save_figures

    folder = out or logs[0].parent
    names = [log.stem for log in logs]
    if len(set(names)) < len(names):
        names = [f"{k}-{name}" for k, name in enumerate(names, start=1)]
    traces = [read_drawn(log) for log in logs]
    figures = []
    with working("drawing figures"):
        # First what may be refused, so that nothing is left behind.
        together = save_comparison(traces, names, folder) if len(logs) > 1 else []
        for name, trace in zip(names, traces, strict=True):
            figures += save_figures(trace, folder, name)
    for figure in [*figures, *together]:
        print(figure)


def replay(
    logs: Logs,
    save: Annotated[Path | None, typer.Option(help="Write a Rerun recording (.rrd).")] = None,
    screenshot: Annotated[Path | None, typer.Option(help="Write a picture (.png).")] = None,
    serve: Annotated[
        bool, typer.Option("--serve", help="Serve the web viewer on this machine, until Ctrl-C.")
    ] = False,
    port: Port = 9090,
    bind: Bind = LOCAL,
    at: Annotated[float | None, typer.Option(help="Time of --screenshot (s).")] = None,
    tab: Annotated[str, typer.Option(help="The tab that is open at first.")] = "Tracking",
    side_by_side: Annotated[
        bool, typer.Option(help="The arms of several logs beside, not in one another.")
    ] = False,
) -> None:
    """Open a log, or up to eight to compare, in the Rerun viewer."""
    require_page(serve, bind)
    require("viewer", "dnnmso replay")
    from dnnmso_mj import replay as viewer

    if save is not None:
        with working("converting"):
            viewer.save_rrd(logs, save, tab, side_by_side=side_by_side)
        print(save)
    if screenshot is not None:
        with working("drawing"):
            viewer.screenshot(logs, screenshot, t=at, tab=tab, side_by_side=side_by_side)
        print(screenshot)
    if serve:
        viewer.serve(logs, port, tab, side_by_side=side_by_side, bind=bind)
    elif save is None and screenshot is None:
        viewer.open_viewer(logs, tab, side_by_side=side_by_side)


def info(log: Log, as_json: Json = False) -> None:
    """Say what a log holds; torn logs too."""
    from dnnmso_mj.reading import log_info

    found = log_info(log)
    if as_json:
        events = [vars(event) for event in found.events]
        print(json.dumps(vars(found) | {"path": str(found.path), "events": events}, default=dict))
        return
    from rich.table import Table

    table = Table(title=str(found.path), show_header=False)
    rows = {
        "scenario": found.scenario,
        "seed": found.seed,
        "status": f"{found.status} {found.reason}".strip(),
        "complete": "yes" if found.complete else "no: `dnnmso recover` makes it whole",
        "ticks": f"{found.ticks} ({found.duration:g} s)",
        "size": f"{found.size / 1e6:.2f} MB",
        "channels": listing(found.channels),
        "attachments": f"{len(found.attachments)} ({sum(found.attachments.values()) / 1e6:.2f} MB)",
        "versions": listing(found.versions),
        "commit": found.git_commit or "unknown",
        **({"resumed": listing(found.resumed)} if found.resumed else {}),
    }
    for name, value in rows.items():
        table.add_row(name, str(value))
    for name, metric in found.metrics.items():
        table.add_row(name, number(metric))
    for event in found.events:
        table.add_row(f"event {event.t:.3f} s", f"{event.level}: {event.message}")
    print_table(table)


def recover(
    log: Log,
    out: Annotated[Path | None, typer.Option(help="Default: LOG-recovered.mcap.")] = None,
) -> None:
    """Make a whole log of the readable prefix of a torn one."""
    from dnnmso_mj.reading import recover as recover_log

    found = recover_log(log, out or log.with_name(f"{log.stem}-recovered.mcap"))
    print(f"{found.path}: {found.ticks} ticks ({found.duration:g} s)")
