"""Logs for the tests, and a child process that writes one until it is stopped.

As a program: log_samples.py LOG COUNTER TICKS appends so many ticks and waits; COUNTER, mapped into
memory, says at every moment how many.
"""

from __future__ import annotations

import mmap
import signal
import sys
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dnnmso_mj.recording import McapRecorder
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.scene import Scene
from dnnmso_mj.trace import FLAGS, Event, RunInfo, StepLayout

MJCF = (Path(__file__).parents[1] / "models" / "two_link.xml").read_text()
LAYOUT = StepLayout(n_joints=2, n_layers=4)
OK = RunInfo(status="ok", seed=7)
METRICS = {"rmse": 1.25e-4, "bound_violations": 3, "diverged": False, "settling_time": None}


def scenario(**parts: Any) -> Scenario:
    reference = {"kind": "sinusoid"}
    controller = {"kind": "dnn_mso", "observer": {"K2": 10.0}}  # stable at every dt in use
    return Scenario.model_validate(
        {"name": "sample", "reference": reference, "controller": controller, "seed": 7, **parts}
    )


def scene() -> Scene:
    return Scene(mujoco.MjModel.from_xml_string(MJCF))


def rows(count: int, layout: StepLayout = LAYOUT, dt: float = 1e-3) -> np.ndarray:
    """Random rows, with a true clock and flags of 0 and 1. More rows begin like fewer."""
    rng = np.random.default_rng(5)
    out = rng.normal(size=(count, layout.width))
    out[:, layout.slices["t"]] = (np.arange(count) * dt)[:, None]
    for name in FLAGS:
        out[:, layout.slices[name]] = out[:, layout.slices[name]] > 0.0
    return out


def blocks(data: np.ndarray, size: int = 30) -> list[np.ndarray]:
    """Rows as the loop hands them over: a block at a time, not of the size the log has."""
    return [data[k : k + size] for k in range(0, len(data), size)]


def recorder(path: Path, layout: StepLayout = LAYOUT, **parts: Any) -> McapRecorder:
    return McapRecorder(path, layout, scenario(**parts), scene(), MJCF)


def append_all(path: Path, data: np.ndarray, info: RunInfo = OK) -> None:
    """A finished log of these rows and nothing else."""
    with recorder(path) as log:
        for block in blocks(data):
            log.append(block)
        log.finish(info)


def write_log(
    path: Path, count: int = 230, layout: StepLayout = LAYOUT, **parts: Any
) -> np.ndarray:
    """A finished log with events, a snapshot and metrics; returns its rows."""
    data = rows(count, layout)
    with recorder(path, layout, **parts) as log:
        log.snapshot("controller", 0.0, {"W": np.arange(6.0).reshape(2, 3)})
        for block in blocks(data):
            log.append(block)
        log.event(Event(0.1, "warning", "torque limit reached"))
        log.snapshot("controller", 0.2, {"W": np.full(3, 0.1), "n": np.array(4)})
        log.finish(RunInfo(status="ok", seed=7, wall_s=0.25, metrics=METRICS))
    return data


def append_and_wait(path: Path, counter: Path, ticks: int) -> None:
    """Append rows, a block a millisecond as the loop does, then wait for a signal."""
    data = np.resize(rows(1000), (ticks, LAYOUT.width))
    done = 0
    with counter.open("r+b") as file, mmap.mmap(file.fileno(), 8) as shared, recorder(path) as log:
        for block in blocks(data):
            log.append(block)
            done += len(block)
            shared[:] = done.to_bytes(8, sys.byteorder)
            time.sleep(1e-3)
        signal.pause()


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    append_and_wait(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
