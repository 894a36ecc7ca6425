"""What each part of `dnn_mso_replay` is worth: leave one out at a time, and write the table.

    python docs/ablation.py                # four seeds, some minutes
    python docs/ablation.py --seeds 2 --jobs 1

The page docs/dnn_mso_replay.md keeps its own words; what stands between its markers is replaced.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from dnnmso_mj.loading import load_scenario
from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.simulation import simulate
from dnnmso_mj.trace import Trace

PAGE = Path(__file__).parent / "dnn_mso_replay.md"
BEGIN, END = "<!-- numbers begin: docs/ablation.py -->", "<!-- numbers end -->"
KIND = "dnn_mso_replay"
FROZEN_AT, ON = 50.0, 13.0  # s, and for how long the network goes on alone

WITHOUT = {
    "nothing: the whole law": [],
    "replay": ["replay.samples=0"],
    "displacement": ["replay.position_spread=0", "replay.velocity_spread=0"],
    "the mean of weights": ["rate.average=1e-9"],
    "the second order of the feed-forward": ["feed_forward=1"],
    "the feed-forward": ["feed_forward=0"],
    "the laws of the rates (η = 0.001 throughout)": ["rate.eta_min=0.001", "replay.eta=0.001"],
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    with ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn")) as pool:
        jobs = {
            (left_out, column): [pool.submit(measure, sets, seed) for seed in range(given.seeds)]
            for left_out, sets in WITHOUT.items()
            for column, measure in COLUMNS.items()
        }
        found = {key: [job.result() for job in seeds] for key, seeds in jobs.items()}
    text = table(found, given.seeds)
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    after = rest.split(END)[1]
    PAGE.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{after}", encoding="utf-8")
    print(text)


def table(found: dict[tuple[str, str], list[float | None]], seeds: int) -> str:
    """Markdown: the median over seeds and, behind it, the largest."""
    lines = [f"Seeds 0 to {seeds - 1}: median [largest].", ""]
    lines.append("| without | " + " | ".join(COLUMNS) + " |")
    lines.append("| --- |" + " --- |" * len(COLUMNS))
    for left_out in WITHOUT:
        cells = " | ".join(_cell(found[left_out, column]) for column in COLUMNS)
        lines.append(f"| {left_out} | {cells} |")
    return "\n".join(lines)


def _cell(values: list[float | None]) -> str:
    """A run that diverged counts as infinite."""
    numbers = np.array([np.inf if value is None else value for value in values])
    words = [
        f"{x:.2g}" if np.isfinite(x) else "diverged" for x in (np.median(numbers), numbers.max())
    ]
    return words[0] if words[0] == words[1] == "diverged" else f"{words[0]} [{words[1]}]"


def run(name: str, sets: list[str], seed: int, *more: str) -> Trace:
    """A shipped scenario with the controller that lacks something."""
    keys = [f"controller.{key}" for key in sets]
    scenario = load_scenario(name, [*keys, f"seed={seed}", *more], controller=KIND)
    return simulate(scenario, watch=False)


def _rmse(trace: Trace, first: float) -> float | None:
    """Of the true angles from `first` (s) on."""
    if trace.info.status != "ok":
        return None
    error = (trace["q"] - trace["q_ref"])[trace["t"] >= first]
    return float(np.sqrt(np.mean(error**2)))


def steady(sets: list[str], seed: int) -> float | None:
    """`rmse_steady` on the paper's scenario."""
    trace = run("paper", sets, seed)
    return _rmse(trace, trace.scenario.duration / 2)


def chatter(sets: list[str], seed: int) -> float | None:
    """`tau_chatter` on the paper's scenario."""
    metrics = compute_metrics(run("paper", sets, seed))
    return None if metrics["diverged"] else metrics["tau_chatter"]


def frozen(sets: list[str], seed: int) -> float | None:
    """The network alone, after `FROZEN_AT` of learning, on the trajectory that it learned from."""
    event = f"events=[{{kind: freeze, at: {FROZEN_AT}, what: all}}]"
    trace = run("paper", sets, seed, f"duration={FROZEN_AT + ON}", event)
    return _rmse(trace, FROZEN_AT)


def hard(sets: list[str], seed: int) -> float | None:
    """The last 10 s of the hard scenario, payload, noise and limit included."""
    trace = run("hard", sets, seed)
    return _rmse(trace, trace.scenario.duration - 10.0)


COLUMNS: dict[str, Callable[[list[str], int], float | None]] = {
    "`paper`: `rmse_steady`, rad": steady,
    "`paper`: chatter, N·m a step": chatter,
    "frozen at 50 s, network alone: RMSE, rad": frozen,
    "`hard`: RMSE of the last 10 s, rad": hard,
}

if __name__ == "__main__":
    main()
