"""One scenario, run and logged: the simulation, its log and its metrics together."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from dnnmso_mj.assets import read_assets
from dnnmso_mj.errors import LogError, RunInterrupted
from dnnmso_mj.interrupts import interrupted_once, raise_lost
from dnnmso_mj.logged import LoggedRun, judge
from dnnmso_mj.paths import find_model, logs_dir
from dnnmso_mj.plant import Mjcf
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
        RunInterrupted: Ctrl-C; the log is whole, with the metrics of what was run. Another Ctrl-C
            while the log is being ended does nothing.
    """
    mjcf = Mjcf.read(find_model(scenario.plant.model))
    pace = real_time_pace(scenario) if real_time else AS_FAST_AS_CAN_BE
    simulation = Simulation(scenario, mjcf, pace=pace)
    scene = Scene(simulation.plant.model)
    if live is not None:
        live.begin(scenario, scene, simulation.layout)
    with _open_log(simulation, scene, mjcf, out, force) as recorder:
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
    recorder.flush()
    done = judge(recorder.path, scenario, layout, info, recorder.ticks)
    recorder.finish(done.info)
    if live is not None:
        live.end(done.info)
    return done


def _open_log(
    simulation: Simulation, scene: Scene, mjcf: Mjcf, out: Path | None, force: bool
) -> McapRecorder:
    scenario, files = simulation.scenario, read_assets(mjcf)
    if out is not None:
        return McapRecorder(
            out, simulation.layout, scenario, scene, mjcf.text, force=force, files=files
        )
    for number in range(1, MAX_NUMBERED):
        suffix = f"-{number}" if number > 1 else ""
        path = logs_dir() / f"{scenario.name}{suffix}.mcap"
        if path.exists():
            continue
        try:
            return McapRecorder(path, simulation.layout, scenario, scene, mjcf.text, files=files)
        except LogError:
            if not path.exists():
                raise
    raise LogError(
        f"{logs_dir()} holds {MAX_NUMBERED - 1} logs of {scenario.name}; "
        "name one with --out, or clear the folder"
    )
