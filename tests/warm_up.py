"""Compile what the tests call, in a process of its own: see `dnnmso_mj.compile_loop` for why."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np

from dnnmso_mj.controllers import Inputs
from dnnmso_mj.learner import build_learner
from dnnmso_mj.loading import controller_kinds, load_scenario
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import Madam, Network
from dnnmso_mj.simulation import Simulation, simulate

DOUBLE = "controller.network.precision=float64"


def main() -> None:
    """On all cores: every controller's loop and its parts, the interpreted loop, and learners."""
    kinds = controller_kinds()
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        jobs = [pool.submit(warm_up, kind) for kind in kinds]
        jobs += [pool.submit(warm_up, kind, DOUBLE) for kind in ("dnn_mso", "classical_mso")]
        jobs += [pool.submit(learn), pool.submit(interpret)]
        for job in jobs:
            job.result()


def warm_up(kind: str, *sets: str) -> None:
    """A controller's loop, and its `update` and `dynamics` on their own."""
    scenario = load_scenario("paper", [*sets, "duration=0.01"], controller=kind)
    simulate(scenario)
    simulation = Simulation(scenario, Mjcf.read(find_model(scenario.plant.model)))
    simulation.controller.update(Inputs.zeros(scenario.n_joints))
    simulation.controller.dynamics(np.zeros(2 * scenario.n_joints))


def interpret() -> None:
    """The loop that the interpreter drives, of a controller that takes no time to compile."""
    scenario = load_scenario(
        "paper", ["duration=0.01", "imperfections.jitter=0.001"], controller="pd"
    )
    simulation = Simulation(scenario, Mjcf.read(find_model(scenario.plant.model)))
    del simulation.controller.ticks
    simulation.run(MemoryRecorder(simulation.layout, scenario.n_ticks))


def learn() -> None:
    """Learners of both precisions."""
    for precision in ("float32", "float64"):
        learner = build_learner(Network(precision=precision), Madam(), 4, 4, 0)
        learner.predict(np.zeros(4))
        learner.learn(np.zeros(4))


if __name__ == "__main__":
    main()
