"""The command `dnnmso`: every command is a few lines over the library.

Exit status: 0 done; 1 the run diverged or a check failed; 2 bad input; 130 interrupted.
"""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from rich.console import Console
from rich.table import Table

from dnnmso_mj import __version__
from dnnmso_mj.errors import DnnmsoError

if TYPE_CHECKING:
    from dnnmso_mj.simulate import Progress
    from dnnmso_mj.trace import Trace

DIVERGED = 1
BAD_INPUT = 2
INTERRUPTED = 130

app = typer.Typer(
    help="Run, prove, replay and measure the DNN-MSO controller on a MuJoCo arm.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

Log = Annotated[Path, typer.Argument(help="A log that `dnnmso run` wrote (.mcap).")]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a key, e.g. plant.gravity=1.62."),
]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]


def main() -> NoReturn:
    """Entry point: run the command line; people's errors are one message and status 2."""
    warnings.showwarning = _show_warning
    warnings.simplefilter("always", UserWarning)
    try:
        app(prog_name="dnnmso")
    except DnnmsoError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(BAD_INPUT)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)
    sys.exit(0)


def _show_warning(
    message: Warning | str, category: type[Warning], *_place: object, **_file: object
) -> None:
    if issubclass(category, UserWarning):
        print(f"warning: {message}", file=sys.stderr)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(__version__)
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    pass


@app.command()
def run(
    scenario: Annotated[str, typer.Argument(help="A scenario file, or the name of a shipped one.")],
    overrides: Overrides = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the initial weights.")] = None,
    out: Annotated[Path | None, typer.Option(help="The log; default logs/NAME.mcap.")] = None,
    force: Annotated[bool, typer.Option(help="Replace an existing --out.")] = False,
    plot: Annotated[bool, typer.Option(help="Draw the figures beside the log.")] = True,
    as_json: Json = False,
) -> None:
    """Run a scenario headless: log, figures, summary."""
    from dnnmso_mj.loading import load_scenario
    from dnnmso_mj.run import run_logged

    sets = [*(overrides or []), *([] if seed is None else [f"seed={seed}"])]
    loaded = load_scenario(scenario, sets)
    with _progress(f"{loaded.name}", loaded.n_ticks) as progress:
        done = run_logged(loaded, out, force=force, progress=progress)
    figures = []
    if plot and len(done.trace) > 0:
        from dnnmso_mj.plots import save_figures

        with _working("drawing figures"):
            figures = save_figures(done.trace, done.log.parent, done.log.stem)
    info = done.trace.info
    if as_json:
        print(json.dumps({
            "status": info.status,
            "reason": info.reason,
            "scenario": loaded.name,
            "log": str(done.log),
            "figures": [str(figure) for figure in figures],
            "seed": info.seed,
            "wall_s": info.wall_s,
            "metrics": dict(info.metrics),
        }))  # fmt: skip
    else:
        _print_summary(done.trace, done.log, figures)
    if info.status == "diverged":
        print(f"diverged: {info.reason}", file=sys.stderr)
        raise typer.Exit(DIVERGED)


@app.command()
def check(
    states: Annotated[int, typer.Option(min=1, help="Random states for each model.")] = 10_000,
    model: Annotated[
        str, typer.Option(help="point_mass, rod, or an MJCF with bodies link1 and link2.")
    ] = "two_link",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the states and arms.")] = 0,
    as_json: Json = False,
) -> None:
    """Hold MuJoCo against the analytic M, V, G and accelerations."""
    from dnnmso_mj.check import TOLERANCE, check_dynamics
    from dnnmso_mj.dynamics import LINKS
    from dnnmso_mj.paths import find_model
    from dnnmso_mj.plant import Mjcf

    one = [links for links in LINKS if links == model]
    mjcf = Mjcf.read(find_model("two_link" if one else model))
    with _working("comparing"):
        results = [check_dynamics(mjcf, links, states, seed) for links in one or LINKS]
    passed = all(result.passed for result in results)
    if as_json:
        errors = {result.links: result.errors for result in results}
        document = {"status": "ok" if passed else "failed", "states": states, "seed": seed}
        print(json.dumps(document | {"tolerance": TOLERANCE, "max_relative_error": errors}))
    else:
        table = Table(title=f"MuJoCo against the formula: largest relative error, {states} states")
        for name in ("model", "M", "V", "G", "qdd", "verdict"):
            table.add_column(name)
        for result in results:
            cells = [f"{error:.1e}" for error in result.errors.values()]
            table.add_row(result.links, *cells, "ok" if result.passed else "FAILED")
        Console(markup=False).print(table)
        print(f"allowed: {TOLERANCE:g} for each")
    if not passed:
        raise typer.Exit(DIVERGED)


@app.command()
def plot(
    logs: Annotated[list[Path], typer.Argument(help="One log, or several to compare.")],
    out: Annotated[Path | None, typer.Option(help="Folder; default beside the first log.")] = None,
) -> None:
    """Draw the paper's figures and the theory from logs."""
    from dnnmso_mj.plots import save_comparison, save_figures
    from dnnmso_mj.reading import read_trace

    folder = out or logs[0].parent
    names = [log.stem for log in logs]
    if len(set(names)) < len(names):
        names = [f"{k}-{name}" for k, name in enumerate(names, start=1)]
    traces = [read_trace(log) for log in logs]
    figures = []
    with _working("drawing figures"):
        for name, trace in zip(names, traces, strict=True):
            figures += save_figures(trace, folder, name)
        if len(logs) > 1:
            figures += save_comparison(traces, names, folder)
    for figure in figures:
        print(figure)


@app.command()
def replay(
    log: Log,
    save: Annotated[Path | None, typer.Option(help="Write a Rerun recording (.rrd).")] = None,
    screenshot: Annotated[Path | None, typer.Option(help="Write a picture (.png).")] = None,
    serve: Annotated[bool, typer.Option(help="Serve the web viewer on 127.0.0.1.")] = False,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Of --serve.")] = 9090,
    at: Annotated[float | None, typer.Option(help="Time of --screenshot (s).")] = None,
    tab: Annotated[str, typer.Option(help="Open tab of --save and --screenshot.")] = "Tracking",
) -> None:
    """Open a log in the Rerun viewer."""
    from dnnmso_mj import replay as viewer

    if save is not None:
        with _working("converting"):
            viewer.save_rrd(log, save, tab)
        print(save)
    if screenshot is not None:
        with _working("drawing"):
            viewer.screenshot(log, screenshot, t=at, tab=tab)
        print(screenshot)
    if serve:
        viewer.serve(log, port)
    elif save is None and screenshot is None:
        viewer.open_viewer(log)


@app.command()
def info(log: Log, as_json: Json = False) -> None:
    """Say what a log holds; torn logs too."""
    from dnnmso_mj.reading import log_info

    found = log_info(log)
    if as_json:
        events = [vars(event) for event in found.events]
        print(json.dumps(vars(found) | {"path": str(found.path), "events": events}, default=dict))
        return
    table = Table(title=str(found.path), show_header=False)
    rows = {
        "scenario": found.scenario,
        "seed": found.seed,
        "status": f"{found.status} {found.reason}".strip(),
        "complete": "yes" if found.complete else "no: `dnnmso recover` makes it whole",
        "ticks": f"{found.ticks} ({found.duration:g} s)",
        "size": f"{found.size / 1e6:.2f} MB",
        "channels": _listing(found.channels),
        "attachments": f"{len(found.attachments)} ({sum(found.attachments.values()) / 1e6:.2f} MB)",
        "versions": _listing(found.versions),
        "commit": found.git_commit or "unknown",
    }
    for name, value in rows.items():
        table.add_row(name, str(value))
    for name, value in found.metrics.items():
        table.add_row(name, _number(value))
    for event in found.events:
        table.add_row(f"event {event.t:.3f} s", f"{event.level}: {event.message}")
    Console(markup=False).print(table)


@app.command()
def recover(
    log: Log,
    out: Annotated[Path | None, typer.Option(help="Default: LOG-recovered.mcap.")] = None,
) -> None:
    """Make a whole log of the readable prefix of a torn one."""
    from dnnmso_mj.reading import recover as recover_log

    found = recover_log(log, out or log.with_name(f"{log.stem}-recovered.mcap"))
    print(f"{found.path}: {found.ticks} ticks ({found.duration:g} s)")


@app.command()
def schema() -> None:
    """Print the JSON Schema of a scenario."""
    from dnnmso_mj.loading import scenario_schema

    print(json.dumps(scenario_schema(), indent=2))


@app.command()
def scenarios(as_json: Json = False) -> None:
    """List the scenarios that ship."""
    from dnnmso_mj.loading import list_scenarios

    found = list_scenarios()
    if as_json:
        print(json.dumps([{"name": name, "description": text} for name, text in found]))
        return
    table = Table("name", "description")
    for name, text in found:
        table.add_row(name, text)
    Console(markup=False).print(table)


def _working(what: str) -> AbstractContextManager[object]:
    """A spinner on standard error, when that is a terminal, for work of unknown length."""
    console = Console(stderr=True)
    return console.status(f"{what} …") if console.is_terminal else nullcontext()


@contextmanager
def _progress(name: str, n_ticks: int) -> Iterator[Progress]:
    """A bar on standard error, when that is a terminal; it takes the number of new ticks."""
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    columns = (TextColumn(name), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Bar(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(name, total=n_ticks)
        yield lambda ticks: bar.advance(task, ticks)


def _print_summary(trace: Trace, log: Path, figures: list[Path]) -> None:
    info = trace.info
    table = Table(title=f"{trace.scenario.name}, seed {info.seed}: {info.status}")
    table.add_column("metric")
    table.add_column("value", justify="right")
    table.add_column("unit")
    for name, value in info.metrics.items():
        table.add_row(name, _number(value), UNITS.get(name, ""))
    console = Console(soft_wrap=True, markup=False)
    console.print(table)
    simulated = len(trace) * trace.scenario.dt
    print(f"{simulated:g} s simulated in {info.wall_s:.2f} s")
    print(f"log      {_near(log)}")
    for figure in figures:
        print(f"figure   {_near(figure)}")
    print(f"replay   dnnmso replay {_near(log)}")


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


def _near(path: Path) -> Path:
    """The path as a person here would type it."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path


def _number(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else "none" if value is None else str(value)


def _listing(items: Mapping[str, object]) -> str:
    return ", ".join(f"{name} {value}" for name, value in items.items())
