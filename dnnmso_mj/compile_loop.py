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
from typing import TYPE_CHECKING, Any

from numba.core import event

from dnnmso_mj.compiling import CompileNotice
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import Pd, Scenario
from dnnmso_mj.sources import python_path

if TYPE_CHECKING:
    from dnnmso_mj.tick import World


def compile_elsewhere(run: Any, arguments: tuple[Any, ...], scenario: Scenario, mjcf: Mjcf) -> None:
    """Have `run` compiled for these arguments by another process, unless that has been done.

    Where no process can be started, this one compiles when `run` is called.

    Args:
        run: a controller's `run_ticks`.
        arguments: what it will be called with.
        scenario, mjcf: what another process makes such arguments of.
    """
    if not is_compiled(run, arguments):
        _elsewhere(scenario, mjcf)


def compile_halves_elsewhere(world: World, scenario: Scenario, mjcf: Mjcf) -> None:
    """The same of the two halves of a tick, which every controller without a loop of its own has.

    Args:
        world: what they will be called with.
        scenario, mjcf: what another process makes such a world of, with any controller.
    """
    if not all(is_compiled(*call) for call in _halves(world)):
        _elsewhere(scenario.model_copy(update={"controller": Pd(kind="pd")}), mjcf, halves=True)


def _halves(world: World) -> list[tuple[Any, tuple[Any, ...]]]:
    from dnnmso_mj.controllers.measured import empty_command
    from dnnmso_mj.tick import begin_tick, end_tick

    command = empty_command(world.tau.size)
    return [(begin_tick, (world, 0)), (end_tick, (world, command, 0))]


def _elsewhere(scenario: Scenario, mjcf: Mjcf, *, halves: bool = False) -> None:
    with suppress(OSError):
        subprocess.run(
            [sys.executable, "-P", "-m", "dnnmso_mj.compile_loop"],
            input=json.dumps([_whole(scenario), mjcf.text, mjcf.folder, halves]).encode(),
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

    scenario, text, folder, halves = json.loads(sys.stdin.buffer.read())
    simulation = Simulation(Scenario.model_validate_json(scenario), Mjcf(text, folder))
    ticks = compiled_ticks(simulation.controller)
    with event.install_listener("numba:compile", CompileNotice()):
        if halves:
            for half, arguments in _halves(simulation.stage.world):
                half.compile(tuple(map(half.typeof_pyval, arguments)))
        elif ticks is not None:
            ticks.run(simulation.stage.world, ticks.parts, 0, 0)


if __name__ == "__main__":
    main()
