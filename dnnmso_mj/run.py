"""One scenario, run and logged: the simulation, its log and its metrics together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dnnmso_mj.errors import LogError
from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.paths import find_model, logs_dir
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.reading import read_trace
from dnnmso_mj.recording import McapRecorder
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.scene import Scene
from dnnmso_mj.simulate import Progress, Simulation
from dnnmso_mj.trace import Trace

MAX_NUMBERED = 10_000


@dataclass(frozen=True)
class LoggedRun:
    """A finished run: its columns, and the log they were read back from."""

    trace: Trace
    log: Path


def run_logged(
    scenario: Scenario,
    out: Path | None = None,
    *,
    force: bool = False,
    progress: Progress | None = None,
) -> LoggedRun:
    """Run a scenario and leave a log with metrics.

    The metrics are computed from what the log says, so a log that does not hold its run shows at
    once.

    Args:
        scenario: the experiment.
        out: the log; by default logs/NAME.mcap, or logs/NAME-2.mcap … where that exists.
        force: whether an existing `out` is replaced.
        progress: called now and then with the number of ticks done since.

    Raises:
        ScenarioError: the model cannot be used; no log is left behind.
        LogError: the log exists or cannot be written.
    """
    mjcf = Mjcf.read(find_model(scenario.plant.model))
    simulation = Simulation(scenario, mjcf)
    with _open_log(simulation, mjcf, out, force) as recorder:
        info = simulation.run(recorder, progress)
        recorder.flush()
        if recorder.ticks:
            trace = read_trace(recorder.path)
        else:  # diverged before its first row
            empty = np.empty((0, simulation.layout.width))
            trace = Trace(simulation.layout.columns(empty), scenario, info)
        written: dict[str, Any] = {
            "versions": trace.info.versions,
            "git_commit": trace.info.git_commit,
        }
        trace = replace(trace, info=replace(info, **written))
        info = replace(trace.info, metrics=compute_metrics(trace))
        recorder.finish(info)
    return LoggedRun(replace(trace, info=info), recorder.path)


def _open_log(simulation: Simulation, mjcf: Mjcf, out: Path | None, force: bool) -> McapRecorder:
    scene = Scene(simulation.plant.model)
    scenario = simulation.scenario
    if out is not None:
        return McapRecorder(out, simulation.layout, scenario, scene, mjcf.text, force=force)
    for number in range(1, MAX_NUMBERED):
        suffix = f"-{number}" if number > 1 else ""
        path = logs_dir() / f"{scenario.name}{suffix}.mcap"
        if path.exists():
            continue
        try:
            return McapRecorder(path, simulation.layout, scenario, scene, mjcf.text)
        except LogError:
            if not path.exists():
                raise
    raise LogError(
        f"{logs_dir()} holds {MAX_NUMBERED - 1} logs of {scenario.name}; "
        "name one with --out, or clear the folder"
    )
