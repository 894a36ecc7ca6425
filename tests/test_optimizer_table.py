"""The table of optimisers by depth: the runs behind it, its gradient columns and its words."""

from __future__ import annotations

import importlib.util
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from dnnmso_mj.controllers import build_controller
from dnnmso_mj.network import TorchNetwork
from dnnmso_mj.scenario import Adam, Madam
from dnnmso_mj.simulation import simulate

SCRIPT = Path(__file__).parents[1] / "docs" / "optimizers.py"


def load_script():
    spec = importlib.util.spec_from_file_location("optimizers", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules["optimizers"] = module
    spec.loader.exec_module(module)
    return module


optimizers = load_script()


def case_of(rule: str, eta: float, **changes):
    case = optimizers.Case(rule, 2, "tanh", 6, 0.1, eta)
    return case._replace(**changes)


def test_a_case_is_the_papers_scenario_with_its_rule_and_network():
    adam = optimizers.scenario_of(case_of("adam", 3e-4), seed=7)
    assert adam.controller.rule == Adam(kind="adam", eta=3e-4)
    assert adam.controller.network.hidden == (6, 6)
    assert (adam.seed, adam.duration) == (7, 0.1)
    madam = optimizers.scenario_of(case_of("madam", 0.03), seed=7)
    assert madam.controller.rule == Madam(eta=0.03, eta_max=1.0)
    assert madam.controller.model_copy(update={"madam": Madam()}) == adam.controller.model_copy(
        update={"optimizer": madam.controller.optimizer}
    )


def test_gradient_column_is_autograds(two_link):
    scenario = optimizers.scenario_of(case_of("sgd", 0.1), seed=1)
    trace, controller = simulate(scenario), build_controller(scenario, two_link)
    found = optimizers.gradient_ratio(controller, trace)
    shape, squares = controller.learner.shape, np.zeros(2)
    net = TorchNetwork(shape, controller.learner.state()["weights"])
    for k in np.linspace(50, 99, optimizers.SAMPLES).astype(int):
        for W in net.parameters:
            W.grad = None
        x = torch.tensor(np.append(trace["q"][k], trace["qd"][k]))
        net(x).backward(torch.tensor(-trace["e_obs"][k]))
        squares += [float((net.parameters[i].grad ** 2).sum()) for i in (0, -1)]
    assert found == pytest.approx(np.sqrt(squares[0] / squares[1]), rel=1e-10)


def test_each_case_takes_the_rate_with_the_least_median_error():
    errors = {1e-4: (math.inf, 1.0, 1.0), 1e-3: (0.3, 0.1, math.inf), 1e-2: (0.1, 0.4, 0.5)}
    options = [case_of("madam", eta) for eta in errors]
    found = {
        optimizers.Task(option, seed, watched=False): {"rmse_steady": errors[option.eta][seed]}
        for option in options
        for seed in range(3)
    }
    assert optimizers.best(options, range(3), found).eta == 1e-3


def test_a_row_counts_diverged_runs_as_infinitely_bad_and_marks_a_rate_at_the_end_of_its_grid():
    fine = dict.fromkeys(optimizers.COLUMNS, 1.0) | {"diverged": 0.0, "rmse_steady": 1e-3}
    lost = {"diverged": 1.0, "rmse_steady": math.inf}
    cells = list(optimizers.row(case_of("madam", 3e-2), [fine, *[lost] * 4]))
    assert cells[:4] == ["2", "madam", "0.03*", "inf [inf, inf]"]
    assert cells[-1] == "4 of 5"
    assert list(optimizers.row(case_of("madam", 1e-3), [fine] * 3))[2:4] == [
        "0.001",
        "0.001 [0.001, 0.001]",
    ]


def test_a_run_that_diverges_is_measured_as_one():
    found = optimizers.measure(optimizers.Task(case_of("sgd", 1000.0), 0, watched=True))
    assert found == {"diverged": 1.0, "rmse_steady": math.inf}
    found = optimizers.measure(optimizers.Task(case_of("adam", 1e-3), 0, watched=True))
    assert set(found) == {"diverged", "rmse_steady", *optimizers.COLUMNS}
    assert all(math.isfinite(value) for value in found.values())


@pytest.mark.parametrize("words", [["--rules", "lion"], ["--depths", "1,x"], ["--seeds", "0"]])
def test_words_that_make_no_sense_are_refused(words):
    command = [sys.executable, SCRIPT, *words]
    run = subprocess.run(command, check=False, capture_output=True, text=True)
    assert run.returncode == 2
    assert "allowed" in run.stderr
