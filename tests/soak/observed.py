"""`dnnmso run --real-time` in a process that stamps what happens: an account that is not its own.

    python -m soak.observed FOLDER [--ordinary] [--overrun '{"TICK": MS}'] -- ARGUMENTS OF RUN

FOLDER/start.txt says when tick 0 is due (ns of the monotonic clock), as soon as that is settled.
With --ordinary the run has no right to a better priority than others. With --overrun the controller
is one in Python, which computes too long at those ticks, and FOLDER/stamps.npy has four times of
each tick: before and after it was waited for and sensed, before and after its command was acted on.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from dnnmso_mj import run
from dnnmso_mj.__main__ import main
from dnnmso_mj.controllers import Command, Inputs
from dnnmso_mj.simulation import Simulation
from dnnmso_mj.tick import START_NS
from soak.pressure import give_up_priority

START, STAMPS = "start.txt", "stamps.npy"


class Busy:
    """A controller in Python that computes for longer at some ticks.

    Args:
        controller: what it commands.
        overrun: ms by tick.
    """

    def __init__(self, controller: Any, overrun: dict[int, float]) -> None:
        self._controller, self._overrun = controller, overrun
        self.n_layers = controller.n_layers
        self.tick = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._controller, name)

    def update(self, inputs: Inputs) -> Command:
        until = time.monotonic_ns() + round(self._overrun.get(self.tick, 0.0) * 1e6)
        command: Command = self._controller.update(inputs)
        while time.monotonic_ns() < until:
            pass
        return command


class Observed(Simulation):
    """A simulation that says when it starts."""

    folder: Path

    def _run_block(self, first: int, count: int, recorder: Any) -> None:
        if first == 0:
            whole = self.folder / f"{START}.part"
            whole.write_text(str(int(self.stage.world.counts[START_NS])))
            whole.rename(self.folder / START)
        super()._run_block(first, count, recorder)


def stamp(simulation: Simulation, busy: Busy) -> np.ndarray:
    """Stamp every tick of a simulation's run: (ticks, 4) int64, ns, filled as it goes on."""
    stamps = np.zeros((simulation.scenario.n_ticks, 4), np.int64)
    sense, act = simulation.stage.sense, simulation.stage.act

    def stamped_sense(k: int) -> bool:
        busy.tick = k
        stamps[k, 0] = time.monotonic_ns()
        in_time = sense(k)
        stamps[k, 1] = time.monotonic_ns()
        return in_time

    def stamped_act(k: int, command: Command) -> bool:
        stamps[k, 2] = time.monotonic_ns()
        ended = act(k, command)
        stamps[k, 3] = time.monotonic_ns()
        return ended

    simulation.stage.sense, simulation.stage.act = stamped_sense, stamped_act
    return stamps


def observe() -> None:
    """Run as the command line says."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--overrun", type=json.loads)
    parser.add_argument("--ordinary", action="store_true")
    split = sys.argv.index("--")
    ours, theirs = parser.parse_args(sys.argv[1:split]), sys.argv[split + 1 :]
    if ours.ordinary:  # such a right ends with the program that had it
        give_up_priority()
        words = [word for word in sys.argv[1:] if word != "--ordinary"]
        os.execv(sys.executable, [sys.executable, "-m", "soak.observed", *words])
    Observed.folder = ours.folder
    kept: list[np.ndarray] = []

    def build(scenario: Any, mjcf: Any, **more: Any) -> Simulation:
        if ours.overrun is None:
            return Observed(scenario, mjcf, **more)
        overrun = {int(tick): float(ms) for tick, ms in ours.overrun.items()}
        busy: Any = Busy(Simulation(scenario, mjcf).controller, overrun)
        simulation = Observed(scenario, mjcf, controller=busy, **more)
        kept.append(stamp(simulation, busy))
        return simulation

    run.Simulation = build
    sys.argv = ["dnnmso", "run", *theirs]
    try:
        main()
    finally:
        if kept:
            np.save(ours.folder / STAMPS, kept[0])


if __name__ == "__main__":
    observe()
