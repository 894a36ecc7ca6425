"""Compile what the tests call, in a process of its own: see `dnnmso_mj.compile_loop` for why."""

from __future__ import annotations

import numpy as np

from dnnmso_mj.controllers import Inputs
from dnnmso_mj.learner import build_learner
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import Madam, Network
from dnnmso_mj.simulate import Simulation, simulate


def main() -> None:
    """Every loop that ships, every `update` on its own, and learners in both precisions."""
    double = "controller.network.precision=float64"
    for name, sets in (
        ("paper", []),
        ("paper", [double]),
        ("paper_no_network", []),
        ("classical_mso", []),
        ("classical_mso", [double]),
        ("paper", ["controller.kind=rbf_mso"]),
        ("paper", ["controller.kind=lewis_nn"]),
    ):
        scenario = load_scenario(name, [*sets, "duration=0.01"])
        simulate(scenario)
        simulation = Simulation(scenario, Mjcf.read(find_model(scenario.plant.model)))
        simulation.controller.update(Inputs.zeros(scenario.n_joints))
    for precision in ("float32", "float64"):
        learner = build_learner(Network(precision=precision), Madam(), 4, 4, 0)
        learner.predict(np.zeros(4))
        learner.learn(np.zeros(4))


if __name__ == "__main__":
    main()
