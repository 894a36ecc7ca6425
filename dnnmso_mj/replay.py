"""A log in the Rerun viewer: as a file, in a window, in a browser, or as a picture."""

from __future__ import annotations

import contextlib
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from mcap.records import Attachment

from dnnmso_mj.errors import DnnmsoError, LogError, ScenarioError
from dnnmso_mj.log.format import MODEL, unwritable
from dnnmso_mj.log.prefix import Prefix
from dnnmso_mj.plant import Mjcf, build_spec, compile_spec
from dnnmso_mj.reading import read_snapshots, read_trace
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.scene import Scene
from dnnmso_mj.viewer.process import (
    check_display,
    check_rerun,
    free_port,
    headless_viewer,
    picture,
    rerun,
    until_interrupted,
)
from dnnmso_mj.viewer.stamps import TIMELINE
from dnnmso_mj.viewer.web import web_server


def save_rrd(log: Path, out: Path, first_tab: str = "Tracking") -> Path:
    """Convert a log to a Rerun recording that carries its own layout.

    Args:
        log: an MCAP log, complete or torn.
        out: the .rrd to write; an existing one is replaced once the new one is whole.
        first_tab: the tab of plots that is open at first: Tracking, Motion, Learning (of a run
            with a network), Theory or Timing.

    Returns:
        `out`.

    Raises:
        LogError: the log cannot be read, has no such tab, or `out` cannot be written; nothing is
            left behind.
        MissingExtraError: rerun is not installed.
    """
    with _replacing(out, ".rrd") as partial:
        _convert(log, partial, first_tab)
    return out


def open_viewer(log: Path) -> None:
    """Show a log in the native viewer, until its window is closed or Ctrl-C.

    Raises:
        DnnmsoError: there is no display, or the viewer cannot start.
        LogError, MissingExtraError: as `save_rrd`.
    """
    check_display(
        "Use `dnnmso replay` with --serve (a browser), --screenshot FILE.png, or --save FILE.rrd"
    )
    with (
        until_interrupted(),
        _converted(log) as (rrd, _),
        rerun("--port", str(free_port()), str(rrd)) as viewer,
    ):
        viewer.wait()


def serve(log: Path, port: int = 9090) -> None:
    """Show a log to browsers on this machine, and to no others, until Ctrl-C.

    Args:
        log: an MCAP log.
        port: of the web page, whose address is printed on standard output.

    Raises:
        DnnmsoError: the port is taken, or the server cannot start.
        LogError, MissingExtraError: as `save_rrd`.
    """
    with (
        until_interrupted(),
        _converted(log) as (rrd, _),
        web_server(port, str(rrd)) as server,
    ):
        print(server.page, flush=True)
        print("Ctrl-C ends it.", file=sys.stderr)
        server.process.wait()


def screenshot(
    log: Path,
    png: Path,
    *,
    t: float | None = None,
    tab: str = "Tracking",
    size: tuple[int, int] = (1600, 900),
) -> Path:
    """Draw the viewer's window to a file, without a display.

    Args:
        log: an MCAP log.
        png: the picture to write; an existing one is replaced once the new one is whole.
        t: simulated time to show (s); the end of the run by default.
        tab: the tab of plots to show, as `first_tab` of `save_rrd`.
        size: width and height (pixels).

    Returns:
        `png`.

    Raises:
        MissingExtraError: rerun is not installed, or the system has no Vulkan driver.
        LogError, DnnmsoError: as `save_rrd`; or the run has no time t; or a view shows nothing.
    """
    with _replacing(png, ".png") as partial, _converted(log, tab) as (rrd, end):
        if t is not None and not 0.0 <= t <= end:
            raise DnnmsoError(f"t = {t} s; allowed: 0 to {end:g} s, the end of the run")
        with headless_viewer(rrd, size) as client:
            client.set_time(TIMELINE, duration=end if t is None else t, play_state="paused")
            partial.write_bytes(picture(client))
    return png


def _convert(log: Path, out: Path, first_tab: str) -> float:
    """Write the recording of a log; returns the time of the run's last tick (s)."""
    check_rerun()
    from dnnmso_mj.viewer.rrd import rrd_bytes

    trace = read_trace(log)
    out.write_bytes(rrd_bytes(trace, _scene(log, trace.scenario), first_tab, read_snapshots(log)))
    return float(trace["t"][-1])


def _scene(log: Path, scenario: Scenario) -> Scene:
    """The robot of a log, from the model that the log holds and the scenario's masses and lengths.

    N.B. meshes and includes are not in the log: they are looked for where the model was.
    """
    records = (r for r in Prefix(log) if isinstance(r, Attachment) and r.name == MODEL)
    model = next(records, None)
    if model is None:
        raise LogError(f"{log}: no attachment {MODEL!r} to draw the robot from. Run it again.")
    plant = scenario.plant
    try:
        mjcf = Mjcf(model.data.decode(), str(Path(plant.model).parent))
        return Scene(compile_spec(build_spec(plant, scenario.dt, mjcf), plant.model))
    except (ScenarioError, UnicodeDecodeError) as error:
        raise LogError(f"{log}: its robot cannot be drawn: {error}") from error


@contextlib.contextmanager
def _converted(log: Path, first_tab: str = "Tracking") -> Iterator[tuple[Path, float]]:
    """A log's recording in a temporary file, and its last time (s)."""
    with tempfile.TemporaryDirectory(prefix="dnnmso-") as folder:
        rrd = Path(folder) / f"{log.stem}.rrd"
        try:
            end = _convert(log, rrd, first_tab)
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
