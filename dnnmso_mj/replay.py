"""Logs in the Rerun viewer: as a file, in a window, in a browser, or as a picture.

Every function takes one log, or a sequence of up to eight to compare in one viewer.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from dnnmso_mj.assets import put_back
from dnnmso_mj.errors import DnnmsoError, LogError, ScenarioError
from dnnmso_mj.extras import require
from dnnmso_mj.log.format import unwritable
from dnnmso_mj.plant import build_spec, compile_spec
from dnnmso_mj.reading import Snapshot
from dnnmso_mj.recorded import Recorded, read_recorded
from dnnmso_mj.scene import Scene
from dnnmso_mj.viewer.plot import TIMELINE
from dnnmso_mj.viewer.process import (
    LOCAL,
    check_display,
    free_port,
    headless_viewer,
    picture,
    rerun,
    until_interrupted,
)
from dnnmso_mj.viewer.summary import drawable
from dnnmso_mj.viewer.web import check_bind, web_server

Logs = Path | Sequence[Path]


def save_rrd(
    logs: Logs, out: Path, first_tab: str = "Tracking", *, side_by_side: bool = False
) -> Path:
    """Convert logs to a Rerun recording that carries its own layout.

    Args:
        logs: MCAP logs, complete or torn, of robots with as many joints.
        out: the .rrd to write; an existing one is replaced once the new one is whole.
        first_tab: the tab of plots that is open at first: Tracking, Learning (of a controller that
            learns), Theory, Timing or Scene.
        side_by_side: whether the arms of several logs stand beside one another.

    Returns:
        `out`.

    Raises:
        LogError: a log cannot be read or shown with the others, has no such tab, or `out` cannot
            be written; nothing is left behind.
        MissingExtraError: rerun is not installed.
    """
    with _replacing(out, ".rrd") as partial:
        _convert(_several(logs), partial, first_tab, side_by_side)
    return out


def open_viewer(logs: Logs, first_tab: str = "Tracking", *, side_by_side: bool = False) -> None:
    """Show logs in the native viewer, until its window is closed or Ctrl-C.

    Raises:
        DnnmsoError: there is no display, or the viewer cannot start.
        LogError, MissingExtraError: as `save_rrd`.
    """
    check_display(
        "Use `dnnmso replay` with --serve (a browser), --screenshot FILE.png, or --save FILE.rrd"
    )
    with (
        until_interrupted(),
        _converted(logs, first_tab, side_by_side) as (rrd, _),
        rerun("--port", str(free_port()), str(rrd)) as viewer,
    ):
        viewer.wait()


def serve(
    logs: Logs,
    port: int = 9090,
    first_tab: str = "Tracking",
    *,
    side_by_side: bool = False,
    bind: str = LOCAL,
) -> None:
    """Show logs to browsers until Ctrl-C, unless told otherwise to those on this machine alone.

    Args:
        logs: MCAP logs.
        port: of the web page, whose address is printed on standard output.
        first_tab, side_by_side: as in `save_rrd`.
        bind: the IP address to listen on; who reaches it beside this machine is said on standard
            error.

    Raises:
        DnnmsoError: the port is taken, or the server cannot start.
        LogError, MissingExtraError: as `save_rrd`.
    """
    check_bind(bind)
    with (
        until_interrupted(),
        _converted(logs, first_tab, side_by_side) as (rrd, _),
        web_server(port, str(rrd), bind=bind) as server,
    ):
        print(server.page, flush=True)
        if server.exposed:
            print(server.exposed, file=sys.stderr)
        print("Ctrl-C ends it.", file=sys.stderr)
        server.process.wait()


def screenshot(
    logs: Logs,
    png: Path,
    *,
    t: float | None = None,
    tab: str = "Tracking",
    size: tuple[int, int] = (1600, 900),
    side_by_side: bool = False,
) -> Path:
    """Draw the viewer's window to a file, without a display.

    Args:
        logs: MCAP logs.
        png: the picture to write; an existing one is replaced once the new one is whole.
        t: simulated time to show (s); the end of the run by default.
        tab: the tab of plots to show, as `first_tab` of `save_rrd`.
        size: width and height (pixels).
        side_by_side: as in `save_rrd`.

    Returns:
        `png`.

    Raises:
        MissingExtraError: rerun is not installed, or the system has no Vulkan driver.
        LogError, DnnmsoError: as `save_rrd`; or the run has no time t; or a view shows nothing.
    """
    with (
        _replacing(png, ".png") as partial,
        _converted(logs, tab, side_by_side) as (rrd, end),
    ):
        if t is not None and not 0.0 <= t <= end:
            raise DnnmsoError(f"t = {t} s; allowed: 0 to {end:g} s, the end of the run")
        with headless_viewer(rrd, size) as client:
            client.set_time(TIMELINE, duration=end if t is None else t, play_state="paused")
            partial.write_bytes(picture(client))
    return png


def _several(logs: Logs) -> Sequence[Path]:
    return [logs] if isinstance(logs, Path) else logs


def _convert(logs: Sequence[Path], out: Path, first_tab: str, side_by_side: bool) -> float:
    """Write the recording of some logs; returns the last time in it (s)."""
    require("viewer", "the viewer")
    from dnnmso_mj.viewer.rrd import Run, rrd_bytes

    runs = []
    for name, log in zip(run_names(logs), logs, strict=True):
        found = read_recorded(log)
        snapshots = _snapshots(found)
        runs.append(Run(name, found.trace, _scene(found), snapshots, found.segments))
    out.write_bytes(rrd_bytes(runs, first_tab, side_by_side=side_by_side))
    last_ticks = [float(run.trace["t"][-1]) for run in runs]
    return max([*last_ticks, *(snapshot.t for run in runs for snapshot in run.snapshots)])


def _snapshots(log: Recorded) -> list[Snapshot]:
    """The states of its controller, in the order of time."""
    name, dt = "controller", log.trace.scenario.dt
    ticks = sorted(tick for tick, what in log.snapshots if what == name)
    return [Snapshot(name, tick * dt, log.arrays(tick, name)) for tick in ticks]


def run_names(logs: Sequence[Path]) -> list[str]:
    """A name for each log that no other has: its file's, with its folder's or a number if need be.

    Args:
        logs: one or more; the same may be there twice.
    """
    names = []
    for log in logs:
        stem = log.stem
        folders = {other.resolve().parent for other in logs if other.stem == stem}
        name = f"{log.resolve().parent.name}/{stem}" if len(folders) > 1 else stem
        names.append(drawable(name))
    before = [names[:k].count(name) for k, name in enumerate(names)]
    return [f"{name} ({k + 1})" if k else name for name, k in zip(names, before, strict=True)]


def _scene(log: Recorded) -> Scene:
    """The robot of a log, from the model that it holds and its scenario's masses and lengths."""
    text = log.model()
    scenario = log.trace.scenario
    try:
        with tempfile.TemporaryDirectory() as folder:
            mjcf = put_back(text, log.files, Path(folder))
            spec = build_spec(scenario.plant, scenario.dt, mjcf)
            return Scene(compile_spec(spec, scenario.plant.model))
    except ScenarioError as error:
        raise LogError(f"{log.path}: its robot cannot be drawn: {error}") from error


@contextlib.contextmanager
def _converted(logs: Logs, first_tab: str, side_by_side: bool) -> Iterator[tuple[Path, float]]:
    """The recording of some logs in a temporary file, and the last time in it (s)."""
    several = _several(logs)
    with tempfile.TemporaryDirectory(prefix="dnnmso-") as folder:
        rrd = Path(folder) / f"{several[0].stem}.rrd"
        try:
            end = _convert(several, rrd, first_tab, side_by_side)
        except OSError as error:
            raise unwritable(rrd, error) from error
        yield rrd, end


@contextlib.contextmanager
def _replacing(path: Path, suffix: str) -> Iterator[Path]:
    """A file to write in place of `path`, which it replaces when the block is left without error.

    Raises:
        LogError: `path` has another suffix, or cannot be written.
    """
    if path.suffix != suffix:
        raise LogError(f"{path}: allowed: a file name that ends in {suffix}")
    try:
        with tempfile.TemporaryDirectory(prefix=f".{path.name}-", dir=path.parent) as folder:
            partial = Path(folder) / path.name
            yield partial
            partial.replace(path)
    except OSError as error:
        raise unwritable(path, error) from error
