"""One scenario, run and logged: the simulation, its log and its metrics together."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from dnnmso_mj.assets import read_assets
from dnnmso_mj.errors import LogError, RunInterrupted, UnloggedRunError
from dnnmso_mj.interrupts import interrupted_once, raise_lost
from dnnmso_mj.logged import LoggedRun, judge
from dnnmso_mj.paths import find_model, logs_dir
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.reading import log_info
from dnnmso_mj.realtime import left_in_peace, real_time_pace
from dnnmso_mj.recording import McapRecorder
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.scene import Scene
from dnnmso_mj.simulation import Progress, Simulation
from dnnmso_mj.stage import AS_FAST_AS_CAN_BE
from dnnmso_mj.tee import Tee
from dnnmso_mj.trace import Event, RunInfo, StepLayout

if TYPE_CHECKING:
    from dnnmso_mj.viewer.live import LiveView

MAX_NUMBERED = 10_000


def run_logged(
    scenario: Scenario,
    out: Path | None = None,
    *,
    force: bool = False,
    real_time: bool = False,
    progress: Progress | None = None,
    live: LiveView | None = None,
) -> LoggedRun:
    """Run a scenario and leave a log with metrics.

    The metrics are computed from what the log says, so a log that does not hold its run shows at
    once.

    Args:
        scenario: the experiment.
        out: the log; by default logs/NAME.mcap, or logs/NAME-2.mcap … where that exists.
        force: whether an existing `out` is replaced.
        real_time: whether ticks are paced by the wall clock; see `realtime`.
        progress: called now and then with the number of ticks done since.
        live: a viewer to show the run in while it goes on.

    Raises:
        ScenarioError: the model cannot be used; no log is left behind.
        LogError: the log exists or cannot be written.
        DnnmsoError: the live view cannot start; no log is left behind.
        UnloggedRunError: the log could not be written on; it holds the run until then.
        RunInterrupted: Ctrl-C; the log is whole, with the metrics of what was run. Another Ctrl-C
            while the log is being ended does nothing.
    """
    mjcf = Mjcf.read(find_model(scenario.plant.model))
    pace = real_time_pace(scenario) if real_time else AS_FAST_AS_CAN_BE
    simulation = Simulation(scenario, mjcf, pace=pace)
    scene = Scene(simulation.plant.model)
    if live is not None:
        live.begin(scenario, scene, simulation.layout)
    with _open_log(simulation, scene, mjcf, out, force, real_time) as recorder:
        sink = recorder if live is None else Tee(recorder, live)

        def run(progress: Progress) -> RunInfo:
            with left_in_peace() if real_time else nullcontext() as priority:
                if priority:
                    sink.event(Event(0.0, "info", f"real time, {priority}"))
                return simulation.run(sink, progress)

        return run_to_end(run, recorder, scenario, simulation.layout, progress, live)


def run_to_end(
    run: Callable[[Progress], RunInfo],
    recorder: McapRecorder,
    scenario: Scenario,
    layout: StepLayout,
    progress: Progress | None,
    live: LiveView | None = None,
) -> LoggedRun:
    """Run, and end the log, and the live view, with the metrics of what was run.

    Args:
        run: fills the log, and calls what it is given now and then.
        recorder: of the log.
        scenario: that is run.
        layout: of the log's rows.
        progress: called then with the number of ticks done since.
        live: the view, which the run fills too.

    Raises:
        UnloggedRunError: the log could not be written on; it holds the run until then.
        RunInterrupted: Ctrl-C; the log is whole, with the metrics of what was run. Another Ctrl-C
            while the log is being ended does nothing.
    """

    def told(done: int) -> None:
        raise_lost()
        if progress is not None:
            progress(done)

    with interrupted_once() as end:
        started = time.perf_counter()
        try:
            info = run(told)
        except KeyboardInterrupt as stop:
            end()
            wall = time.perf_counter() - started
            info = RunInfo("interrupted", scenario.seed, wall, reason="Ctrl-C")
            raise RunInterrupted(_finish(recorder, scenario, layout, info, live)) from stop
        except LogError as error:
            if not recorder.broken:
                raise
            end()
            wall = time.perf_counter() - started
            info = RunInfo("failed", scenario.seed, wall, reason=str(error))
            run_so_far = judge(recorder.path, scenario, layout, info, *_readable(recorder))
            raise UnloggedRunError(str(error), run_so_far) from error
        end()
        return _finish(recorder, scenario, layout, info, live)


def _finish(
    recorder: McapRecorder,
    scenario: Scenario,
    layout: StepLayout,
    info: RunInfo,
    live: LiveView | None,
) -> LoggedRun:
    """Compute the metrics of what the log holds, and end log and view with them."""
    done: LoggedRun | None = None
    try:
        ticks = recorder.flush()
        done = judge(recorder.path, scenario, layout, info, ticks, recorder.readable)
        recorder.finish(done.info)
    except LogError as error:
        if not recorder.broken:
            raise
        if done is None:
            done = judge(recorder.path, scenario, layout, info, *_readable(recorder))
        failed = replace(done.info, status="failed", reason=str(error))
        raise UnloggedRunError(str(error), replace(done, info=failed)) from error
    if live is not None:
        live.end(done.info)
    return done


def _readable(recorder: McapRecorder) -> tuple[int, Path]:
    """How many ticks of a log that could not be written can be read, and where."""
    try:
        return log_info(recorder.readable).ticks, recorder.readable
    except LogError:
        return 0, recorder.path


def open_first_free(
    names: Iterable[Path], make: Callable[[Path], McapRecorder]
) -> McapRecorder | None:
    """A log of the first name that nobody has, nor takes meanwhile; None: there is none."""
    for path in names:
        if os.path.lexists(path):
            continue
        try:
            return make(path)
        except LogError:
            if not os.path.lexists(path):
                raise
    return None


def _open_log(
    simulation: Simulation,
    scene: Scene,
    mjcf: Mjcf,
    out: Path | None,
    force: bool,
    real_time: bool,
) -> McapRecorder:
    scenario, files = simulation.scenario, read_assets(mjcf)

    def make(path: Path) -> McapRecorder:
        return McapRecorder(
            path,
            simulation.layout,
            scenario,
            scene,
            mjcf.text,
            force=force and out is not None,
            real_time=real_time,
            files=files,
        )

    if out is not None:
        return make(out)
    suffixes = ("", *(f"-{number}" for number in range(2, MAX_NUMBERED)))
    names = (logs_dir() / f"{scenario.name}{suffix}.mcap" for suffix in suffixes)
    if (recorder := open_first_free(names, make)) is not None:
        return recorder
    raise LogError(
        f"{logs_dir()} holds {MAX_NUMBERED - 1} logs of {scenario.name}; "
        "name one with --out, or clear the folder"
    )
