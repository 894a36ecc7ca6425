"""A quick proof that runs can be trusted: MuJoCo against the formula, and a run that repeats.

It is done by another process, since a damaged library may end its process without a word.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

from dnnmso_mj.doctor import Finding
from dnnmso_mj.sources import python_path

STATES = 100
DURATION = 0.1  # s
TIMEOUT = 300.0  # s; a first run compiles for half a minute
MEASURED = ("compute_us", "wake_late_us", "deadline_missed")  # of the wall clock


def self_check() -> Iterator[Finding]:
    """M, V, G and q̈ over 100 states, and 0.1 s of the paper's run twice."""
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-m", "dnnmso_mj.doctor.self_check"],
            env=os.environ | {"PYTHONPATH": python_path()},
            capture_output=True,
            text=True,
            timeout=TIMEOUT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        yield Finding("self-check", "run", "broken", f"not done after {TIMEOUT:g} s")
        return
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or [f"ended with status {done.returncode}"]
        yield Finding("self-check", "run", "broken", lines[-1], "see the packages above")
        return
    yield from _told(json.loads(done.stdout.splitlines()[-1]))


def _told(found: dict[str, Any]) -> Iterator[Finding]:
    group = "self-check"
    worst, allowed, name = found["worst"], found["allowed"], "MuJoCo = formula"
    detail = f"largest relative error {worst:.1e}, allowed {allowed:g}"
    if worst <= allowed:
        yield Finding(group, name, "ok", detail)
    else:
        fix = "pip install --force-reinstall mujoco numpy"
        yield Finding(group, name, "broken", detail, fix)
    before = "was compiled" if found["compiled"] else "has been compiled now"
    yield Finding(group, "the paper's loop", "ok", f"{before}; a run of it starts at once")
    if found["same"]:
        yield Finding(group, "a run repeated", "ok", "the same to the last bit")
    else:
        differ = f"differs in {', '.join(found['differ'])}"
        yield Finding(group, "a run repeated", "broken", differ, "report it, with this output")


def check() -> dict[str, Any]:
    """What `self_check` tells; needs all that a run needs."""
    import numpy as np

    from dnnmso_mj.check import TOLERANCE, check_dynamics
    from dnnmso_mj.compile_loop import is_compiled
    from dnnmso_mj.controllers import compiled_ticks
    from dnnmso_mj.dynamics import LINKS
    from dnnmso_mj.loading import load_scenario
    from dnnmso_mj.paths import find_model
    from dnnmso_mj.plant import Mjcf
    from dnnmso_mj.simulation import Simulation, simulate

    mjcf = Mjcf.read(find_model("two_link"))
    errors = [check_dynamics(mjcf, links, STATES).errors.values() for links in LINKS]
    scenario = load_scenario("paper", [f"duration={DURATION}"])
    simulation = Simulation(scenario, mjcf)
    ticks = compiled_ticks(simulation.controller)
    compiled = ticks is not None and is_compiled(
        ticks.run, (simulation.stage.world, ticks.parts, 0, 0)
    )
    one, two = simulate(scenario, mjcf), simulate(scenario, mjcf)
    differ = [key for key in one if key not in MEASURED and not np.array_equal(one[key], two[key])]
    return {
        "worst": float(max(max(values) for values in errors)),
        "allowed": TOLERANCE,
        "compiled": compiled,
        "same": not differ,
        "differ": differ,
    }


if __name__ == "__main__":
    print(json.dumps(check()))
