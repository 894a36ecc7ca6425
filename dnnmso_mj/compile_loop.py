"""Compile a controller's loop in a process of its own, for all others to load from disk.

A process that compiles runs the code it has just made of each function, others run what was put on
disk for the whole loop, and the two may round differently. So that every run of a seed is the same
to the last bit, the first one too, no run compiles its own loop.

`python -m dnnmso_mj.compile_loop` takes a scenario and its model as JSON on standard input.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from contextlib import suppress
from typing import Any

from numba.core import event

from dnnmso_mj.compiling import CompileNotice
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.sources import python_path


def compile_elsewhere(run: Any, arguments: tuple[Any, ...], scenario: Scenario, mjcf: Mjcf) -> None:
    """Have `run` compiled for these arguments by another process, unless that has been done.

    Where no process can be started, this one compiles when `run` is called.

    Args:
        run: a controller's `run_ticks`.
        arguments: what it will be called with.
        scenario, mjcf: what another process makes such arguments of.
    """
    if is_compiled(run, arguments):
        return
    with suppress(OSError):
        subprocess.run(
            [sys.executable, "-P", "-m", "dnnmso_mj.compile_loop"],
            input=json.dumps([_whole(scenario), mjcf.text, mjcf.folder]).encode(),
            env=os.environ | {"PYTHONPATH": python_path()},
            start_new_session=True,  # Ctrl-C is for us, and we end it
            check=False,
        )


def _whole(scenario: Scenario) -> str:
    """A scenario as JSON; one that was cut short lasts again until after all that happens in it."""
    happens = [event.at for event in (*scenario.events, *scenario.real_time.stalls)]
    ends = math.ceil(max(happens, default=0.0) / scenario.dt + 1.0) * scenario.dt
    longer = scenario.model_copy(update={"duration": max(scenario.duration, ends)})
    return longer.model_dump_json()


def is_compiled(run: Any, arguments: tuple[Any, ...]) -> bool:
    """Whether `run` is compiled for these arguments, here or on disk; nothing is loaded."""
    types = tuple(run.typeof_pyval(argument) for argument in arguments)
    on_disk = run._cache
    key = on_disk._index_key(types, run.targetctx.codegen())
    return types in run.overloads or key in on_disk._cache_file._load_index()


def main() -> None:
    """Compile the loop that standard input describes."""
    from dnnmso_mj.controllers import compiled_ticks
    from dnnmso_mj.simulation import Simulation

    scenario, text, folder = json.loads(sys.stdin.buffer.read())
    simulation = Simulation(Scenario.model_validate_json(scenario), Mjcf(text, folder))
    ticks = compiled_ticks(simulation.controller)
    if ticks is not None:
        with event.install_listener("numba:compile", CompileNotice()):
            ticks.run(simulation.world, ticks.parts, 0, 0)


if __name__ == "__main__":
    main()
