"""Print how the paper's controller does with Madam, SGD, Adam and sign-SGD at several depths.

    python docs/optimizers.py [--seeds 10] [--tuning-seeds 3] [--depths 1,2,3,5,8] [--jobs 2]

The paper holds that gradient descent fails in deep networks, since gradients vanish on their way to
the first layers, and that Madam does not. So each rule at each depth gets the learning rate that is
best for it, by the median `rmse_steady` on seeds of its own (from 10,000 on), and is then judged on
seeds 0 and up; a diverged run counts as infinitely bad. The gradient columns are Frobenius norms of
the first and the last layer's gradient, root mean square over states of the run's last half: with
the first weights, and with the last ones.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import track

from dnnmso_mj import kernel
from dnnmso_mj.controllers import build_controller
from dnnmso_mj.controllers.dnn_mso import DnnMsoController
from dnnmso_mj.learner import KernelLearner
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.simulation import Simulation
from dnnmso_mj.trace import Trace

Array = np.ndarray
Measures = dict[str, float]

# The learning rates that a rule may choose from; Madam's η* stays the paper's 100 η, at most 1.
GRIDS: dict[str, tuple[float, ...]] = {
    "madam": (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2),
    "sgd": (1e-3, 3e-3, 1e-2, 3e-2, 1e-1, 3e-1, 1.0, 3.0),
    "adam": (1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2),
    "sign_sgd": (3e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2),
}
ACTIVATIONS = ("sigmoid", "tanh", "relu")
FIRST_TUNING_SEED = 10_000
SAMPLES = 200  # states that the gradient columns are over

COLUMNS = {
    "tau_peak": "`tau_peak`, N·m",
    "tau_chatter": "`tau_chatter`, N·m",
    "gradient_start": "‖g₁‖/‖g_L‖, first weights",
    "gradient_end": "same, last weights",
    "update_first": "‖ΔW₁‖/‖W₁‖",
    "update_last": "‖ΔW_L‖/‖W_L‖",
}
HEADS = ("depth", "rule", "η", "`rmse_steady`, rad: median [quartiles]", *COLUMNS.values())


class Case(NamedTuple):
    """A rule with its learning rate on a network."""

    rule: str
    depth: int  # hidden layers
    activation: str
    width: int  # units of each
    duration: float  # s
    eta: float = math.nan


class Task(NamedTuple):
    """One run; `watched` takes the columns that only the table needs."""

    case: Case
    seed: int
    watched: bool


def scenario_of(case: Case, seed: int) -> Scenario:
    """The paper's scenario with a case's network and rule, in float64."""
    hidden = ",".join([str(case.width)] * case.depth)
    sets = [
        f"seed={seed}",
        f"duration={case.duration}",
        f"controller.network.hidden=[{hidden}]",
        f"controller.network.activation={case.activation}",
        "controller.network.init_scale=null",
        "controller.network.precision=float64",
    ]
    if case.rule == "madam":
        eta_max = min(100 * case.eta, 1.0)
        sets += [f"controller.madam.eta={case.eta}", f"controller.madam.eta_max={eta_max}"]
    else:
        sets += [f"controller.optimizer.kind={case.rule}", f"controller.optimizer.eta={case.eta}"]
    return load_scenario("paper", sets)


def measure(task: Task) -> Measures:
    """Run one seed of a case, and take what the table shows."""
    scenario = scenario_of(task.case, task.seed)
    mjcf = Mjcf.read(find_model(scenario.plant.model))
    simulation = Simulation(scenario, mjcf, watch=task.watched)
    recorder = MemoryRecorder(simulation.layout, scenario.n_ticks)
    trace = recorder.trace(scenario, simulation.run(recorder))
    metrics = compute_metrics(trace)
    if metrics["diverged"]:
        return {"diverged": 1.0, "rmse_steady": math.inf}
    names = ("rmse_steady", "tau_peak", "tau_chatter")
    found = {"diverged": 0.0} | {name: float(metrics[name] or 0.0) for name in names}
    if not task.watched:
        return found
    half = trace["update_ratio"][len(trace) // 2 :]
    return found | {
        "gradient_start": gradient_ratio(build_controller(scenario, mjcf), trace),
        "gradient_end": gradient_ratio(simulation.controller, trace),
        "update_first": float(np.median(half[:, 0])),
        "update_last": float(np.median(half[:, -1])),
    }


def gradient_ratio(controller: object, trace: Trace) -> float:
    """‖g₁‖/‖g_L‖ of a controller's weights, over states and observer errors of the last half."""
    if not isinstance(controller, DnnMsoController):
        raise TypeError(type(controller).__name__)
    learner = controller.learner
    if not isinstance(learner, KernelLearner):
        raise TypeError(type(learner).__name__)
    net, total = learner.net, np.zeros(2)
    g, out = np.zeros_like(net.w), kernel.output_at(learner.net)
    at = np.linspace(len(trace) // 2, len(trace) - 1, SAMPLES).astype(int)
    for x, e_obs in zip(np.hstack([trace["q"], trace["qd"]])[at], trace["e_obs"][at], strict=True):
        learner.predict(x)
        net.deltas[out : out + e_obs.size] = -e_obs
        kernel.gradient(net, g)
        layers = learner.shape.split(kernel.unpack(learner.shape, g))
        total += [(layers[0] ** 2).sum(), (layers[-1] ** 2).sum()]
    return float(np.sqrt(total[0] / total[1]))


def run_all(tasks: Iterable[Task], jobs: int, what: str) -> dict[Task, Measures]:
    """Run every task once, on `jobs` processes."""
    todo = list(tasks)
    console = Console(stderr=True)
    hidden = not console.is_terminal
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        found = pool.imap(measure, todo)
        bar = track(found, what, len(todo), console=console, disable=hidden)
        return dict(zip(todo, bar, strict=True))


def tune(cases: list[Case], seeds: int, jobs: int) -> list[Case]:
    """Each case with the learning rate of its grid that has the least median `rmse_steady`."""
    tuning = range(FIRST_TUNING_SEED, FIRST_TUNING_SEED + seeds)
    tried = {case: [case._replace(eta=eta) for eta in GRIDS[case.rule]] for case in cases}
    tasks = [
        Task(option, seed, watched=False)
        for options in tried.values()
        for option in options
        for seed in tuning
    ]
    found = run_all(tasks, jobs, "tuning")
    return [best(options, tuning, found) for options in tried.values()]


def best(options: list[Case], seeds: Iterable[int], found: dict[Task, Measures]) -> Case:
    """The option with the least median `rmse_steady`."""

    def median(option: Case) -> float:
        errors = [found[Task(option, seed, watched=False)]["rmse_steady"] for seed in seeds]
        return float(np.median(errors))

    return min(options, key=median)


def table(cases: list[Case], seeds: int, found: dict[Task, Measures]) -> str:
    """Markdown rows of the cases of one activation."""
    lines = [f"| {' | '.join([*HEADS, 'diverged'])} |", f"|{' ---: |' * (len(HEADS) + 1)}"]
    for case in cases:
        runs = [found[Task(case, seed, watched=True)] for seed in range(seeds)]
        lines.append(f"| {' | '.join(row(case, runs))} |")
    return "\n".join(lines)


def row(case: Case, runs: list[Measures]) -> Iterator[str]:
    """One case's cells; an η at an end of its grid, where a better one may lie beyond, has a *."""
    grid = GRIDS[case.rule]
    yield str(case.depth)
    yield case.rule
    yield f"{case.eta:g}" + ("*" if case.eta in (grid[0], grid[-1]) else "")
    errors = [run["rmse_steady"] for run in runs]
    low, middle, high = np.quantile(errors, (0.25, 0.5, 0.75), method="nearest")
    yield f"{middle:.3g} [{low:.3g}, {high:.3g}]"
    for name in COLUMNS:
        values = [run[name] for run in runs if name in run]
        yield f"{np.median(values):.3g}" if values else "none"
    yield f"{sum(run['diverged'] for run in runs):g} of {len(runs)}"


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Madam against SGD, Adam and sign-SGD by depth.")
    parser.add_argument("--seeds", type=int, default=10, help="test seeds; default 10")
    parser.add_argument("--tuning-seeds", type=int, default=3, help="for each rate; default 3")
    parser.add_argument("--depths", default="1,2,3,5,8", help="hidden layers; default 1,2,3,5,8")
    parser.add_argument("--width", type=int, default=64, help="units of each; default 64")
    parser.add_argument("--rules", default=",".join(GRIDS), help=f"default {','.join(GRIDS)}")
    parser.add_argument("--activations", default="sigmoid", help=f"of {','.join(ACTIVATIONS)}")
    parser.add_argument("--duration", type=float, default=10.0, help="s of each run; default 10")
    parser.add_argument("--jobs", type=int, default=2, help="processes; default 2")
    given = parser.parse_args()
    try:
        given.depths = [int(depth) for depth in given.depths.split(",")]
    except ValueError:
        parser.error(f"--depths {given.depths}: allowed: whole numbers with commas between")
    given.rules, given.activations = given.rules.split(","), given.activations.split(",")
    for name, values, allowed in (
        ("rules", given.rules, tuple(GRIDS)),
        ("activations", given.activations, ACTIVATIONS),
    ):
        if not set(values) <= set(allowed):
            parser.error(f"--{name} {','.join(values)}: allowed: {', '.join(allowed)}")
    if min(given.seeds, given.tuning_seeds, given.jobs, given.width, *given.depths) < 1:
        parser.error("numbers of seeds, processes, units and layers: allowed: 1 or more")
    if given.seeds > FIRST_TUNING_SEED:
        parser.error(f"--seeds {given.seeds}: allowed: at most {FIRST_TUNING_SEED}")
    return given


def main() -> None:
    given = _arguments()
    cases = [
        Case(rule, depth, activation, given.width, given.duration)
        for activation in given.activations
        for depth in given.depths
        for rule in given.rules
    ]
    chosen = tune(cases, given.tuning_seeds, given.jobs)
    tasks = [Task(case, seed, watched=True) for case in chosen for seed in range(given.seeds)]
    found = run_all(tasks, given.jobs, "judging")
    for activation in given.activations:
        print(f"### {activation}\n")
        print(table([c for c in chosen if c.activation == activation], given.seeds, found), "\n")


if __name__ == "__main__":
    main()
