"""Figures of logs, saved as PNG files."""

from __future__ import annotations

import gc
import io
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.figures.drawing import house_style
from dnnmso_mj.figures.overview import overview_figure
from dnnmso_mj.figures.theory import learning_figure, theory_figure
from dnnmso_mj.figures.tracking import error_figure, torque_figure, tracking_figure
from dnnmso_mj.files import write_whole
from dnnmso_mj.trace import Trace

_COLOURS = 64
_WHITE = 250  # levels above it, of 255


def run_figures(trace: Trace) -> dict[str, Figure]:
    """tracking, error, torque, learning (only with a network) and theory of one run.

    Raises:
        DnnmsoError: the run has no tick.
    """
    _require_ticks({trace.scenario.name: trace})
    title, alone = _title(trace), {"actual": trace}
    with house_style():
        figures = {
            "tracking": tracking_figure(alone, title),
            "error": error_figure(alone, title),
            "torque": torque_figure(alone, title),
        }
        if trace.n_layers:
            figures["learning"] = learning_figure(trace, title)
        figures["theory"] = theory_figure(trace, title)
    return figures


def overview(trace: Trace) -> Figure:
    """Angles, errors and torques of one run in one figure, which a notebook shows by itself.

    Raises:
        DnnmsoError: the run has no tick.
    """
    _require_ticks({trace.scenario.name: trace})
    return overview_figure(trace, _title(trace))


def comparison_figures(traces: Sequence[Trace], labels: Sequence[str]) -> dict[str, Figure]:
    """tracking, error and torque of several runs laid over each other.

    Raises:
        DnnmsoError: no run, a run without a tick, labels that do not name each run, or runs of
            robots with different numbers of joints.
    """
    runs = _named(traces, labels)
    _require_ticks(runs)
    with house_style():
        return {
            "tracking": tracking_figure(runs),
            "error": error_figure(runs),
            "torque": torque_figure(runs),
        }


def save_figures(trace: Trace, out_dir: Path, stem: str) -> list[Path]:
    """Write the figures of one run as `out_dir/stem_NAME.png`, replacing older ones whole.

    Raises:
        DnnmsoError: the run has no tick, or some figures, which are named, cannot be written; the
            others are, and none is half-written.
    """
    with _no_collection():
        figures = run_figures(trace)
        return _save({out_dir / f"{stem}_{name}.png": figure for name, figure in figures.items()})


def save_comparison(traces: Sequence[Trace], labels: Sequence[str], out_dir: Path) -> list[Path]:
    """Write `out_dir/comparison_NAME.png` of several runs, each named by its label.

    Raises:
        DnnmsoError: as `comparison_figures`, or the folder cannot be written.
    """
    with _no_collection():
        figures = comparison_figures(traces, labels)
        return _save({out_dir / f"comparison_{name}.png": f for name, f in figures.items()})


@contextmanager
def _no_collection() -> Iterator[None]:
    """Without garbage collection: it goes through all of matplotlib's objects again and again."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _title(trace: Trace) -> str:
    """Scenario and seed, what is left out, and what became of a run that did not end well."""
    title = f"{trace.scenario.name}, seed {trace.info.seed}"
    ticks = round((trace["t"][-1] - trace["t"][0]) / trace.scenario.dt) + 1
    if ticks > len(trace):
        title += f", outlined by {len(trace)} of {ticks} ticks"
    if trace.info.status == "ok":
        return title
    return f"{title}: {trace.info.status} at t = {trace['t'][-1]:g} s"


def _named(traces: Sequence[Trace], labels: Sequence[str]) -> dict[str, Trace]:
    """Runs by their labels, which must fit them."""
    if not traces or len(labels) != len(traces) or len(set(labels)) != len(labels):
        raise DnnmsoError(
            f"labels {list(labels)} for {len(traces)} runs; "
            "allowed: at least one run, and one label of its own for each"
        )
    joints = {trace.n_joints for trace in traces}
    if len(joints) > 1:
        raise DnnmsoError(
            f"runs with {sorted(joints)} joints cannot be compared; "
            "allowed: robots with the same number of joints"
        )
    as_text = (label.replace("$", r"\$") for label in labels)  # not as formulas
    return dict(zip(as_text, traces, strict=True))


def _require_ticks(runs: Mapping[str, Trace]) -> None:
    for label, trace in runs.items():
        if len(trace) == 0:
            raise DnnmsoError(f"run {label} has 0 ticks: nothing to draw; needed: at least 1")


def _save(figures: Mapping[Path, Figure]) -> list[Path]:
    """Write each figure beside its place, and only then move it there; half in a second process."""
    items = list(figures.items())
    mine, others = items[1::2], items[::2]
    failed: dict[Path, OSError] = {}
    with _drawn_beside(others) as drawn:
        failed |= _write(mine)
    if not drawn():
        failed |= _write(others)
    if failed:
        names = ", ".join(str(path) for path in figures if path in failed)
        reason = next(iter(failed.values())).strerror
        raise DnnmsoError(
            f"cannot write figure {names}: {reason}; choose a folder that can be written"
        )
    return list(figures)


@contextmanager
def _drawn_beside(items: Sequence[tuple[Path, Figure]]) -> Iterator[Callable[[], bool]]:
    """Write figures in a forked process meanwhile; afterwards the value says whether it did.

    A process with more threads than this one cannot be forked safely, and draws alone.
    """
    child = 0
    if threading.active_count() == 1 and (os.cpu_count() or 1) > 1 and hasattr(os, "fork"):
        child = os.fork()
        if child == 0:
            status = 1
            with suppress(BaseException):
                status = 1 if _write(items) else 0
            os._exit(status)
    done = False
    try:
        yield lambda: done
    finally:
        done = child > 0 and os.waitpid(child, 0)[1] == 0


def _write(items: Sequence[tuple[Path, Figure]]) -> dict[Path, OSError]:
    """Draw and write figures; those that could not be written, and why."""
    failed: dict[Path, OSError] = {}
    for path, figure in items:
        with house_style():
            png = png_bytes(figure)
        try:
            write_whole(path, png)
        except OSError as error:
            failed[path] = error
    return failed


def png_bytes(figure: Figure) -> bytes:
    """A figure as PNG of few colours: a fourth of the size, and nobody can tell."""
    canvas: Any = FigureCanvasAgg(figure)  # its methods carry no types
    canvas.draw()
    size = canvas.get_width_height(physical=True)
    picture = Image.frombytes("RGBA", size, bytes(canvas.buffer_rgba())).convert("RGB")
    few = picture.quantize(_COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    # It takes white and its faintest shades together: white is to stay white.
    few.putpalette([255 if level > _WHITE else level for level in few.getpalette() or ()])
    buffer = io.BytesIO()
    few.save(buffer, "png")
    return buffer.getvalue()
