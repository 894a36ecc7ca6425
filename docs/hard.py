"""How the hard scenarios end: the tracking error of the last 10 s, over seeds.

    python docs/hard.py hard hard_delay --seeds 0:100
    python docs/hard.py hard hard_delay --controller dnn_mso --seeds 0:20

`rmse_steady` is of the last half, which begins with the payload; what counts here is what is left
10 s after it.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context

import numpy as np

from dnnmso_mj.loading import load_scenario
from dnnmso_mj.simulation import simulate
from dnnmso_mj.sweep.plan import parse_seeds

LAST = 10.0  # s


def last_error(name: str, controller: str | None, sets: list[str], seed: int) -> float:
    """RMSE (rad) of the last 10 s of a run; infinite if it diverged."""
    trace = simulate(
        load_scenario(name, [*sets, f"seed={seed}"], controller=controller), watch=False
    )
    if trace.info.status != "ok":
        return np.inf
    last = trace["t"] >= trace.scenario.duration - LAST
    return float(np.sqrt(np.mean((trace["q"] - trace["q_ref"])[last] ** 2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenarios", nargs="+")
    parser.add_argument("--controller", help="in place of the scenario's own")
    parser.add_argument("--set", action="append", default=[], help="as of dnnmso run")
    parser.add_argument("--seeds", default="0:10")
    parser.add_argument("--jobs", type=int)
    options = parser.parse_args()
    seeds = parse_seeds(options.seeds)
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        for name in options.scenarios:
            run = partial(last_error, name, options.controller, options.set)
            errors = np.array(list(pool.map(run, seeds)))
            lost = int(np.isinf(errors).sum())
            median, most = np.median(errors), np.quantile(errors, 0.99, method="higher")
            print(
                f"{name}: {len(errors)} seeds, {lost} diverged; RMSE of the last {LAST:g} s: "
                f"median {median:.3g}, p99 {most:.3g}, worst {errors.max():.3g} rad",
                flush=True,
            )


if __name__ == "__main__":
    main()
