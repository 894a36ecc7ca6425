"""`dnnmso run`: one scenario, its log, its figures and a summary."""

from __future__ import annotations

import json
import signal
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dnnmso_mj.cli.live import LOCAL, Bind, Port, Serve, View, live_view
from dnnmso_mj.cli.shared import (
    DIVERGED,
    Json,
    Overrides,
    ScenarioName,
    Trust,
    near,
    number,
    print_table,
    progress_bar,
    working,
)
from dnnmso_mj.errors import (
    DnnmsoError,
    MissingExtraError,
    RunInterrupted,
    ScenarioError,
    UnloggedRunError,
)
from dnnmso_mj.extras import require

if TYPE_CHECKING:
    from dnnmso_mj.logged import LoggedRun
    from dnnmso_mj.timing import Timing

MISSES_SHOWN = 20
ENDED_EARLY = ("interrupted", "failed")
UNITS = {
    "rmse": "rad",
    "rmse_steady": "rad",
    "max_abs_error_steady": "rad",
    "tau_peak": "N·m",
    "tau_chatter": "N·m per step",
    "f_err_rms_steady": "rad/s, rad/s²",
    "settling_time": "s",
    "bound_violations": "ticks",
    "compute_us_p50": "µs",
    "compute_us_p999": "µs",
    "deadline_misses": "ticks",
}


def run(
    scenario: ScenarioName,
    overrides: Overrides = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the initial weights.")] = None,
    out: Annotated[Path | None, typer.Option(help="The log; default logs/NAME.mcap.")] = None,
    force: Annotated[bool, typer.Option(help="Replace an existing log.")] = False,
    real_time: Annotated[
        bool, typer.Option("--real-time", help="Keep to the wall clock, one tick each dt.")
    ] = False,
    view: View = False,
    serve: Serve = False,
    port: Port = 9090,
    bind: Bind = LOCAL,
    plot: Annotated[bool, typer.Option(help="Draw the figures beside the log.")] = True,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Run a scenario: log, figures, summary."""
    from dnnmso_mj.loading import load_scenario, located
    from dnnmso_mj.run import run_logged

    plot = plot and can_draw()
    sets = [*(overrides or []), *([] if seed is None else [f"seed={seed}"])]
    loaded = load_scenario(scenario, sets, trust=trust)
    with live_view(view, serve, port, bind) as live:
        try:
            with progress_bar(f"{loaded.name}", loaded.n_ticks) as progress:
                done = run_logged(
                    loaded, out, force=force, real_time=real_time, progress=progress, live=live
                )
        except ScenarioError as error:
            raise located(error, scenario, sets) from error
        except RunInterrupted as stop:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # all that is left is to say what was run
            if stop.ticks or as_json:
                tell(stop.run, [], as_json=as_json, real_time=real_time)
            ran = f"{stop.ticks * loaded.dt:g} s of {loaded.duration:g} s"
            raise KeyboardInterrupt(f"log: {near(stop.log)} ({ran})") from stop
        except UnloggedRunError as error:
            tell(error.run, [], as_json=as_json, real_time=False)
            raise
        figures, undrawn = draw(done) if plot else ([], None)
        tell(done, figures, as_json=as_json, real_time=real_time)
    if undrawn is not None:
        raise undrawn
    if done.info.status == "diverged":
        print(f"diverged: {done.info.reason}", file=sys.stderr)
        raise typer.Exit(DIVERGED)


def can_draw() -> bool:
    """Whether figures can be drawn; says so if not, since a run is worth having without them."""
    try:
        require("plot", "figures: drawing them")
    except MissingExtraError as error:
        print(f"no {error} (--no-plot: without this line)", file=sys.stderr)
        return False
    return True


def draw(done: LoggedRun) -> tuple[list[Path], DnnmsoError | None]:
    """The figures beside the log, and why there are none of those that could not be written."""
    if done.ticks == 0:
        return [], None
    from dnnmso_mj.plots import save_figures

    try:
        with working("drawing figures"):
            name = done.log.name.removesuffix(".mcap")
            return save_figures(done.drawn(), done.log.parent, name), None
    except DnnmsoError as error:
        return [], error


def tell(done: LoggedRun, figures: list[Path], *, as_json: bool, real_time: bool) -> None:
    """A run's summary, as a table or as one JSON object."""
    from dnnmso_mj.timing import TIMED, timing

    info = done.info
    if as_json:
        print(json.dumps({
            "status": info.status,
            "reason": info.reason,
            "scenario": done.scenario.name,
            "log": str(done.log),
            "figures": [str(figure) for figure in figures],
            "seed": info.seed,
            "wall_s": info.wall_s,
            "metrics": dict(info.metrics),
            **({"real_time": asdict(timing(done.part(*TIMED)))} if real_time else {}),
        }))  # fmt: skip
    else:
        print_summary(done, figures)
        if real_time:
            _print_timing(timing(done.part(*TIMED)))


def print_summary(done: LoggedRun, figures: list[Path], since: int = 0) -> None:
    """Metrics, speed and files of a run, of which the ticks from `since` on were simulated now."""
    from rich.table import Table

    info, scenario = done.info, done.scenario
    table = Table(title=f"{scenario.name}, seed {info.seed}: {info.status}")
    table.add_column("metric")
    table.add_column("value", justify="right")
    table.add_column("unit")
    for name, value in info.metrics.items():
        table.add_row(name, number(value), UNITS.get(name, ""))
    print_table(table, soft_wrap=True)
    simulated = (done.ticks - since) * scenario.dt
    whole = f" of {scenario.duration:g} s" if info.status in ENDED_EARLY else ""
    print(f"{simulated:g} s{whole} simulated in {info.wall_s:.2f} s")
    print(f"log      {near(done.log)}")
    for figure in figures:
        print(f"figure   {near(figure)}")
    print(f"replay   dnnmso replay {near(done.log)}")


def _print_timing(timing: Timing) -> None:
    """How the wall clock was kept: computing apart from waking, and each miss."""
    from rich.table import Table

    table = Table("real time (µs)", *timing.compute_us)
    for name, values in (("computing", timing.compute_us), ("woken late", timing.wake_late_us)):
        table.add_row(name, *(f"{value:.0f}" for value in values.values()))
    print_table(table)
    for cause in ("computing", "waking"):
        print(f"missed by {cause}: {timing.ticks_missed(cause)} ticks")
    for miss in timing.misses[:MISSES_SHOWN]:
        print(f"  t = {miss.t:.3f} s: {miss.ticks} ticks, by {miss.cause}")
    if len(timing.misses) > MISSES_SHOWN:
        print(f"  and {len(timing.misses) - MISSES_SHOWN} more times; all are events of the log")
