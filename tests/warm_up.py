"""Compile what the tests call, in a process of its own: see `dnnmso_mj.compile_loop` for why."""

from __future__ import annotations

import numpy as np

from dnnmso_mj.controllers import Inputs
from dnnmso_mj.learner import build_learner
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import Madam, Network, Scenario
from dnnmso_mj.simulate import Simulation, simulate

RIVALS = ("pd", "pid", "computed_torque", "adrc", "sliding_mode", "rise", "l1")


def main() -> None:
    """Every loop that ships, every `update` on its own, and learners in both precisions."""
    double = "controller.network.precision=float64"
    for name, sets in (
        ("paper", []),
        ("paper", [double]),
        ("paper", ["controller.kind=backstepping"]),
        ("paper_no_network", []),
        ("classical_mso", []),
        ("classical_mso", [double]),
        *(("paper", [f"controller={{kind: {kind}}}"]) for kind in RIVALS),
    ):
        warm_up(load_scenario(name, [*sets, "duration=0.01"]))
    # Scenarios name these by kind alone.
    for kind in ("slotine_li", "concurrent_learning"):
        parts = {"controller": {"kind": kind}, "reference": {"kind": "sinusoid"}}
        warm_up(Scenario.model_validate({"name": kind, "duration": 0.01, **parts}))
    for precision in ("float32", "float64"):
        learner = build_learner(Network(precision=precision), Madam(), 4, 4, 0)
        learner.predict(np.zeros(4))
        learner.learn(np.zeros(4))


def warm_up(scenario: Scenario) -> None:
    """A controller's loop, and its `update` on its own."""
    simulate(scenario)
    simulation = Simulation(scenario, Mjcf.read(find_model(scenario.plant.model)))
    simulation.controller.update(Inputs.zeros(scenario.n_joints))


if __name__ == "__main__":
    main()
