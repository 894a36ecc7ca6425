"""What determinism is tried on: scenarios, run here or in a process of its own.

`python -m soak.trials TRIALS` takes trials as JSON, runs each, and prints their digests as JSON.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from dnnmso_mj import load_scenario, simulate
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.sources import python_path
from soak.sameness import digest

TESTS = Path(__file__).parents[1]
LAW = """
import numpy as np

def act(observation):
    return np.tanh(observation[:2] - 3.0 * observation[2:4] + 0.1 * np.sin(observation[4:6]))

def law():
    return act
"""


@dataclass(frozen=True)
class Trial:
    """A scenario.

    Args:
        source: a shipped one.
        sets: what is changed in it.
        trust: whether that may name code.
    """

    source: str
    sets: tuple[str, ...]
    trust: bool = False

    def scenario(self) -> Scenario:
        """The scenario, loaded."""
        return load_scenario(self.source, list(self.sets), trust=self.trust)

    def digest(self) -> str:
        """Of a run in this process."""
        return digest(simulate(self.scenario()))


def trials(folder: Path, seed: int, duration: float) -> dict[str, Trial]:
    """Trials of every sort: learning, noisy, with a memory, at other steps, interpreted.

    Args:
        folder: for the code of a policy.
        seed: of each.
        duration: of each (s).
    """
    law = folder / "law.py"
    law.write_text(LAW)
    common = (f"duration={duration}", f"seed={seed}")
    policy = f"controller={{kind: policy, python: '{law}:law'}}"
    return {
        "paper": Trial("paper", common),
        "hard": Trial("hard", ("events=[]", *common)),
        "dnn_mso_replay": Trial("replay", ("events=[]", *common)),
        "policy": Trial("paper", (policy, *common), trust=True),
        "pd, dt 0.5 ms": Trial("paper", ("controller={kind: pd}", "dt=0.0005", *common)),
        "classical_mso, dt 2 ms": Trial("classical_mso", ("dt=0.002", *common)),
    }


def elsewhere(
    asked: Sequence[Trial],
    *,
    env: Mapping[str, str] | None = None,
    cwd: Path | None = None,
    options: Sequence[str] = (),
) -> subprocess.Popen[str]:
    """Start trials in a fresh process; `answers` waits for them.

    Args:
        asked: in their order.
        env: what is else in its environment.
        cwd: where it starts.
        options: of Python.
    """
    paths = os.pathsep.join([python_path(), str(TESTS)])
    return subprocess.Popen(
        [sys.executable, *options, "-m", "soak.trials", json.dumps([asdict(t) for t in asked])],
        env=os.environ | {"PYTHONPATH": paths} | dict(env or {}),
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def answers(process: subprocess.Popen[str], seconds: float = 240.0) -> list[str]:
    """The digests that a process of `elsewhere` prints.

    Raises:
        AssertionError: it fails.
        TimeoutExpired: it takes longer; it is killed.
    """
    try:
        out, err = process.communicate(timeout=seconds)
    finally:
        process.kill()
    assert process.returncode == 0, err.strip().splitlines()[-1:]
    found: list[str] = json.loads(out)
    return found


if __name__ == "__main__":
    given = [Trial(t["source"], tuple(t["sets"]), t["trust"]) for t in json.loads(sys.argv[1])]
    print(json.dumps([trial.digest() for trial in given]))
