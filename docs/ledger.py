"""Print the tables of docs/reproduction.md: what each thing the paper leaves open is worth.

    python docs/ledger.py [GROUP ...] [--seeds 10] [--jobs 2]

A group is a question and its variants (docs/ledger.yaml). Each variant runs the paper's 10 s once
for every seed, and a row reports the median over all of them, never the best; a diverged run counts
as infinitely bad, not as missing.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import shlex
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from ruamel.yaml import YAML

from dnnmso_mj.controllers.dnn_mso import DnnMsoController
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.metrics import BOUND_MARGIN, BOUND_ROUNDING, compute_metrics
from dnnmso_mj.monitors import WATCH_EVERY
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import NoNetwork, Scenario
from dnnmso_mj.simulation import Simulation
from dnnmso_mj.trace import Trace

BASE = "paper"
Measures = dict[str, float]
Task = tuple[str, int]  # `--set` texts, seed

STANDARD = ("rmse_steady", "tau_peak", "tau_chatter", "f_err_rms_steady")

# Measure -> heading of its column. A group's first column also shows the range.
HEADINGS = {
    "rmse_steady": "`rmse_steady`, rad",
    "tau_peak": "`tau_peak`, N·m",
    "tau_chatter": "`tau_chatter`, N·m",
    "f_err_rms_steady": "`f_err_rms_steady`",
    "end": "ended at, s",
    "trust_ratio": "turn of the gradient ÷ what trust allows",
    "trust_kept": "trust kept, % of ticks",
    "eta_bound": "Theorem 1's bound on η",
    "eta_allowed": "η below it, % of ticks",
    "update_first": "‖ΔW‖/‖W‖, first",
    "update": "same, last half",
    "update_allowed": "same below the bound, % of ticks",
    "clamped": "clamped, % of ticks",
    "weight_norm": "largest ‖W_l‖",
    "bound_broken": "ours broken, % of ticks",
    "paper_bound_broken": "paper's broken, % of ticks",
    "paper_ultimate": "‖e_r‖ ÷ (ε/λ_min(K)), last half",
    "recall_half": "f̃ of the last weights, last half",
    "recall_second": "same, last 1 s",
    "recall_tenth": "same, last 0.1 s",
    "f_true_rms": "f itself, last half",
    "travel": "Σ ‖ΔW‖/‖W‖ over 1 s",
}


@dataclass(frozen=True)
class Group:
    """One question to the closed loop.

    Args:
        title: what is varied.
        variants: name -> `--set` texts for scenarios/paper, separated by blanks.
        columns: the measures to show.
    """

    title: str
    variants: dict[str, str]
    columns: tuple[str, ...] = STANDARD


def load_groups() -> dict[str, Group]:
    """The groups of docs/ledger.yaml, in its order."""
    found = YAML(typ="safe").load(Path(__file__).with_suffix(".yaml"))
    return {
        name: Group(item["title"], item["variants"], tuple(item.get("columns", STANDARD)))
        for name, item in found.items()
    }


def scenario_of(overrides: str, seed: int) -> Scenario:
    """A variant of scenarios/paper, in float64 unless it says otherwise or has no network."""
    sets = overrides.split()
    if "kind=no_network" not in overrides and "network.precision=" not in overrides:
        sets.append("controller.network.precision=float64")
    return load_scenario(BASE, [*sets, f"seed={seed}"])


def measure(task: Task) -> Measures:
    """Run one variant with one seed, and take everything that any column shows."""
    overrides, seed = task
    scenario = scenario_of(overrides, seed)
    simulation = Simulation(scenario, Mjcf.read(find_model(scenario.plant.model)))
    recorder = MemoryRecorder(simulation.layout, scenario.n_ticks)
    trace = recorder.trace(scenario, simulation.run(recorder))
    metrics = compute_metrics(trace)
    diverged = bool(metrics["diverged"])
    found = {name: math.inf if diverged else _number(metrics[name]) for name in STANDARD}
    found |= {"diverged": float(diverged), "end": len(trace) * scenario.dt}
    found |= tracking_measures(trace, _number(metrics["bound_violations"]))
    if trace.n_layers:
        found |= learning_measures(trace)
    if isinstance(simulation.controller, DnnMsoController):
        found |= knowledge_measures(trace, simulation.controller)
    return found


def tracking_measures(trace: Trace, violations: float) -> Measures:
    """How often the tracking error exceeds our bound and the paper's, with the same margin."""
    error = np.sqrt(trace["lyapunov"])
    within = error <= BOUND_MARGIN * trace["ultimate_bound_paper"] + BOUND_ROUNDING
    first = len(trace) // 2
    epsilon = np.linalg.norm(trace["f_true"] - trace["f_hat"], axis=1)[first:].max()
    return {
        "paper_ultimate": error[first:].max()
        * min(trace.scenario.controller.inversion.K)
        / epsilon,
        "bound_broken": 100 * violations / len(trace),
        "paper_bound_broken": 100 * float(np.mean(~within)),
    }


def learning_measures(trace: Trace) -> Measures:
    """Deep relative trust and Theorem 1's condition, over the ticks that had a gradient."""
    eta = trace.scenario.controller.madam.eta  # type: ignore[union-attr]
    learned = np.flatnonzero(trace["drt_bound"] > 0)
    fresh = learned[learned % WATCH_EVERY == 0]  # held in between
    turn = trace["gradient_change"][fresh].max(axis=1) / trace["drt_bound"][fresh]
    bound = trace["eta_bound"][learned].min(axis=1)
    update = trace["update_ratio"][learned].max(axis=1)
    half = trace["update_ratio"][len(trace) // 2 :]
    return {
        "trust_ratio": float(np.median(turn)),
        "trust_kept": 100 * float(np.mean(turn <= 1)),
        "eta_bound": float(np.median(bound)),
        "eta_allowed": 100 * float(np.mean(eta < bound)),
        "update_first": float(update[0]),
        "update": float(np.median(half.max(axis=1))),
        "update_allowed": 100 * float(np.mean(update < bound)),
        "clamped": 100 * float(np.mean(trace["clipped"])),
        "weight_norm": float(trace["weight_norm"].max()),
        "travel": float(half.mean() / trace.scenario.dt),
    }


def knowledge_measures(trace: Trace, controller: DnnMsoController) -> Measures:
    """Model error (root mean square) of the last weights on states that the run has passed."""
    dt = trace.scenario.dt
    first = len(trace) // 2
    states = np.hstack([trace["q"], trace["qd"]])[first:]
    truth = trace["f_true"][first:]
    learned = np.array([controller.learner.predict(x).copy() for x in states])
    # Rows that are not learned are the measured velocity, and exact.
    square = np.zeros_like(truth)
    square[:, -learned.shape[1] :] = (learned - truth[:, -learned.shape[1] :]) ** 2
    windows = {"recall_tenth": 0.1, "recall_second": 1.0, "recall_half": len(states) * dt}
    found = {name: _rms(square[-round(span / dt) :]) for name, span in windows.items()}
    return found | {"f_true_rms": _rms(truth**2)}


def _rms(squares: np.ndarray) -> float:
    return float(np.sqrt(squares.mean()))


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def tasks_of(overrides: str, seeds: int) -> list[Task]:
    """A variant's runs; one is enough where nothing is drawn."""
    controller = load_scenario(BASE, overrides.split()).controller
    count = 1 if isinstance(controller, NoNetwork) else seeds
    return [(overrides, seed) for seed in range(count)]


def section(name: str, group: Group, seeds: int, results: dict[Task, Measures]) -> str:
    """A group's heading, command and Markdown table."""
    columns = [HEADINGS[column] for column in group.columns]
    columns[0] += ": median [min, max]"
    heads = ["variant", "`dnnmso run paper` with", *columns, "diverged"]
    lines = [
        f"### `{name}`: {group.title}",
        "",
        f"`python docs/ledger.py {name} --seeds {seeds}`",
        "",
        f"| {' | '.join(heads)} |",
        f"|{' --- |' * 2}{' ---: |' * (len(heads) - 2)}",
    ]
    for variant, overrides in group.variants.items():
        runs = [results[task] for task in tasks_of(overrides, seeds)]
        lines.append(f"| {' | '.join(_row(variant, overrides, group.columns, runs))} |")
    return "\n".join(lines) + "\n"


def _row(
    variant: str, overrides: str, columns: tuple[str, ...], runs: list[Measures]
) -> Iterator[str]:
    sets = " ".join(f"--set {shlex.quote(text)}" for text in overrides.split())
    yield variant
    yield f"`{sets}`" if sets else "nothing"
    for k, column in enumerate(columns):
        values = np.array([run.get(column, math.nan) for run in runs])
        spread = f" [{_text(values.min())}, {_text(values.max())}]"
        yield _text(float(np.median(values))) + (spread if k == 0 else "")
    yield f"{sum(run['diverged'] for run in runs):g} of {len(runs)}"


def _text(value: float) -> str:
    return "none" if math.isnan(value) else "∞" if math.isinf(value) else f"{value:.3g}"


def measure_all(tasks: Iterable[Task], jobs: int) -> dict[Task, Measures]:
    """Run every different task once, on `jobs` processes."""
    todo = list(dict.fromkeys(tasks))
    console = Console(stderr=True)
    hidden = not console.is_terminal
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        found = pool.imap(measure, todo)
        bar = track(found, "ledger", len(todo), console=console, disable=hidden)
        return dict(zip(todo, bar, strict=True))


def main() -> None:
    groups = load_groups()
    parser = argparse.ArgumentParser(description="Print the tables of docs/reproduction.md.")
    parser.add_argument("groups", nargs="*", metavar="GROUP", help=f"of {', '.join(groups)}")
    parser.add_argument("--seeds", type=int, default=10, help="runs of each variant; default 10")
    parser.add_argument("--jobs", type=int, default=2, help="processes; default 2")
    given = parser.parse_args()
    for name in given.groups:
        if name not in groups:
            parser.error(f"GROUP = {name}: unknown; allowed: {', '.join(groups)}")
    if min(given.seeds, given.jobs) < 1:
        parser.error("--seeds and --jobs: allowed: 1 or more")
    wanted = {name: groups[name] for name in given.groups or groups}
    variants = [overrides for group in wanted.values() for overrides in group.variants.values()]
    tasks = [task for overrides in variants for task in tasks_of(overrides, given.seeds)]
    results = measure_all(tasks, given.jobs)
    for name, group in wanted.items():
        print(section(name, group, given.seeds, results))


if __name__ == "__main__":
    main()
