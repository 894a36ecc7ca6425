"""Run, in order, every experiment whose numbers docs/findings.md quotes.

    python docs/experiments.py [--only tune,compare] [--list] [--tiny]

Each step is one command that prints itself, what it is estimated to take and what it took. Whole
results stand in logs/findings/, short ones in docs/findings/. A step that is finished for the same
command, code and controllers is not run again; one that was interrupted goes on.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from experiment_steps import ROOT, Step, run

from dnnmso_mj.loading import controller_kinds

CORES = 2
DT = 1e-3  # s, of every scenario here

# Beside each kind, those that can do without a model of the inertia: name -> kind, what is set.
CONSTANT = "controller.{}effectiveness.kind=constant"
HALF = (
    "controller.inversion.effectiveness={kind: constant, b: 0.5}"  # 1.0 is outside what it stands
)
VARIANTS = {
    "dnn_mso_constant": ("dnn_mso", CONSTANT.format("inversion.")),
    "dnn_mso_replay_constant": ("dnn_mso_replay", HALF),
    **{f"{kind}_constant": (kind, CONSTANT.format("")) for kind in ("adrc", "sliding_mode", "l1")},
}
AS_PUBLISHED = ("dnn_mso", "dnn_mso_replay")  # with their own settings, beside the tuned ones
LEARNING = (
    "dnn_mso",
    "dnn_mso_replay",
    "backstepping",
    "classical_mso",
    "rbf_mso",
    "lewis_nn",
    "slotine_li",
    "concurrent_learning",
)

# Ticks a second of one core, for estimates: of a deep network, with a memory, of any other law.
NETWORK, MEMORY, PLAIN = 60_000, 18_000, 100_000
NETWORKS = ("dnn_mso", "classical_mso", "backstepping")
START_UP = 8.0  # s of a command, its checks of controllers included
SEARCHES = 15  # runs of one search of a margin
AUDIT = 290.0  # s of simulated time that one controller and seed are audited for


class Budget(NamedTuple):
    """How much of everything."""

    folder: Path  # of whole results
    short: Path  # of short results
    controllers: Path
    trials: int
    tuning_seeds: str
    seeds: dict[str, str]
    durations: dict[str, float]  # s, where it is not the scenario's own
    optimizers: tuple[str, ...]
    at: tuple[float, ...]  # s


FULL = Budget(
    folder=Path("logs/findings"),
    short=Path("docs/findings"),
    controllers=Path("scenarios/controllers"),
    trials=16,
    tuning_seeds="1000:1002",
    seeds={
        "paper": "0:50",
        "hard": "0:10",
        "margins": "0:3",
        "audit": "0:4",
        "sweep": "0:1000",
        "literature/lewis": "0:10",
        "literature/lb_dnn": "0:2",
    },
    durations={"margins": 6.0},
    optimizers=("--seeds", "4", "--tuning-seeds", "1", "--depths", "1,3,8"),
    at=(10.0, 50.0),
)
TINY = FULL._replace(
    folder=Path("logs/findings_tiny"),
    short=Path("logs/findings_tiny/short"),
    controllers=Path("logs/findings_tiny/controllers"),
    trials=2,
    tuning_seeds="1000",
    seeds=dict.fromkeys(FULL.seeds, "0:2"),
    durations={**dict.fromkeys([*FULL.seeds, "tune"], 0.2), "hard": 20.5},  # beyond its payload
    optimizers=(
        *("--seeds", "1", "--tuning-seeds", "1", "--depths", "1"),
        *("--rules", "madam,sgd", "--duration", "0.5"),
    ),
    at=(0.2,),
)
LENGTHS = {"paper": 10.0, "hard": 40.0, "literature/lewis": 10.0, "literature/lb_dnn": 100.0}


def tuned() -> dict[str, tuple[str, tuple[str, ...]]]:
    """Name of each tuned controller -> its kind, and what is set of it."""
    found: dict[str, tuple[str, tuple[str, ...]]] = {}
    for kind in controller_kinds():
        found[f"{kind}_tuned"] = (kind, ())
    for name, (kind, put) in VARIANTS.items():
        found[f"{name}_tuned"] = (kind, (put,))
    return found


def kind_of(name: str) -> str:
    """Of a controller as commands name it."""
    return tuned().get(Path(name).stem, (name,))[0]


def seconds(names: list[str], simulated: float) -> float:
    """Estimate of as much simulated time (s) of each controller on all cores."""
    kinds = [kind_of(name) for name in names]
    rates = [
        MEMORY if kind == "dnn_mso_replay" else NETWORK if kind in NETWORKS else PLAIN
        for kind in kinds
    ]
    return START_UP + sum(simulated / DT / rate / CORES for rate in rates)


def count(seeds: str) -> int:
    """How many seeds "a:b" or "a" are."""
    first, _, end = seeds.partition(":")
    return int(end) - int(first) if end else 1


def steps(budget: Budget, *, all_there: bool) -> Iterator[Step]:
    """Every step in order; those that compare take what is tuned by then, or, to list, all."""
    yield from _tune(budget)
    files = {name: budget.controllers / f"{name}.yaml" for name in tuned()}
    there = {name: file for name, file in files.items() if all_there or (ROOT / file).exists()}
    shipped = budget.controllers == FULL.controllers
    names = [*AS_PUBLISHED, *(name if shipped else str(file) for name, file in there.items())]
    reads = tuple(there.values())
    for scenario in ("paper", "hard"):
        yield _compare(budget, scenario, names, reads)
    yield _margins(budget, names, reads)
    learning = [name for name in names if kind_of(name) in LEARNING]
    yield _audit(budget, learning, reads)
    for kind in AS_PUBLISHED:
        yield _sweep(budget, kind)
    command = ("python", "docs/optimizers.py", *budget.optimizers)
    yield Step("optimizers", command, 150.0, (Path("docs/optimizers.py"),), resumes=False)
    names = names[len(AS_PUBLISHED) :] or names
    for scenario in ("literature/lewis", "literature/lb_dnn"):
        yield _compare(budget, scenario, names, reads)
    yield _report(budget)


def _lasting(budget: Budget, what: str) -> tuple[str, ...]:
    length = budget.durations.get(what)
    return () if length is None else ("--set", f"duration={length}")


def _table(budget: Budget, name: str) -> tuple[str, ...]:
    return ("--out", f"{budget.folder / name}.parquet", "--json")


def _tune(budget: Budget) -> Iterator[Step]:
    for name, (kind, sets) in tuned().items():
        command = (
            *("dnnmso", "tune", "tuning", "--controller", kind),
            *(word for text in sets for word in ("--set", text)),
            *_lasting(budget, "tune"),
            *("--trials", str(budget.trials), "--seeds", budget.tuning_seeds),
            *("--max-peak", "120", "--out", f"{budget.controllers / name}.yaml"),
            *("--storage", f"{budget.folder / name}.study.sqlite", "--json"),
        )
        simulated = 8.0 * budget.trials * count(budget.tuning_seeds)
        reads = (Path("scenarios/tuning.yaml"),)
        yield Step(
            f"tune_{name.removesuffix('_tuned')}", command, seconds([kind], simulated), reads
        )


def _compare(budget: Budget, scenario: str, names: list[str], reads: tuple[Path, ...]) -> Step:
    name, seeds = f"compare_{Path(scenario).name}", budget.seeds[scenario]
    command = (
        *("dnnmso", "compare", scenario, "--controllers", ",".join(names), "--seeds", seeds),
        *_lasting(budget, scenario),
        *_table(budget, name),
    )
    simulated = LENGTHS[scenario] * count(seeds)
    reads = (*reads, Path(f"scenarios/{scenario}.yaml"))
    return Step(name, command, seconds(names, simulated), reads)


def _margins(budget: Budget, names: list[str], reads: tuple[Path, ...]) -> Step:
    seeds = budget.seeds["margins"]
    command = (
        *("dnnmso", "margins", "paper", "--controllers", ",".join(names), "--seeds", seeds),
        *_lasting(budget, "margins"),
        *_table(budget, "margins"),
    )
    free = ("pd", "pid", "rise", "lewis_nn", "slotine_li", "concurrent_learning")
    rows = [5 if "constant" in name or kind_of(name) in free else 7 for name in names]
    simulated = FULL.durations["margins"] * count(seeds) * SEARCHES
    time = sum(seconds([name], simulated * n) for name, n in zip(names, rows, strict=True))
    return Step("margins", command, time, reads)


def _audit(budget: Budget, names: list[str], reads: tuple[Path, ...]) -> Step:
    seeds = budget.seeds["audit"]
    command = (
        *("dnnmso", "audit", "paper", "--controllers", ",".join(names), "--seeds", seeds),
        *("--at", ",".join(f"{at:g}" for at in budget.at)),
        *("--out", str(budget.folder), "--json"),
    )
    return Step("audit", command, seconds(names, AUDIT * count(seeds)), reads, resumes=False)


def _sweep(budget: Budget, kind: str) -> Step:
    name, seeds = f"weights_{kind}", budget.seeds["sweep"]
    command = (
        *("dnnmso", "sweep", "paper", "--set", f"controller={{kind: {kind}}}", "--seeds", seeds),
        *_lasting(budget, "sweep"),
        *_table(budget, name),
    )
    return Step(name, command, seconds([kind], LENGTHS["paper"] * count(seeds)))


def _report(budget: Budget) -> Step:
    names = ("compare_paper", "compare_hard", "margins", "compare_lewis", "compare_lb_dnn")
    tables = [f"{budget.folder / name}.parquet" for name in names]
    command = ("dnnmso", "report", *tables, "--out", f"{budget.folder / 'findings.html'}")
    reads = tuple(Path(table) for table in tables)
    return Step("report", command, START_UP, reads, resumes=False)


def main() -> None:
    parser = argparse.ArgumentParser(description="Every experiment that docs/findings.md quotes.")
    parser.add_argument("--only", default="", help="steps whose names begin with one of these")
    parser.add_argument("--list", action="store_true", help="say what would be run, and how long")
    parser.add_argument("--tiny", action="store_true", help="a small try of everything")
    given = parser.parse_args()
    budget, only = TINY if given.tiny else FULL, tuple(given.only.split(","))
    total, failed = 0.0, []
    for step in steps(budget, all_there=given.list):
        if not step.name.startswith(only):
            continue
        total += step.seconds
        if given.list:
            print(f"{step.name}: {step.seconds:.0f} s\n  {shlex.join(step.command)}")
        elif not run(step, budget.folder, budget.short):
            failed.append(step.name)
    print(f"\nestimate of all: {total / 60:.0f} min on {CORES} idle cores")
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
