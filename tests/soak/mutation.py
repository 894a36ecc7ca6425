"""Row 15: whoever breaks the mathematics or the log is told so by a test.

Each mutant is a source with one small change, as mutmut makes them (`mutants.py`), and the tests of
that source run against it in a process of its own (`mutation_worker.py`). A mutant that no test
notices is lost, unless `mutation_explained.txt` says why nobody can.
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from soak.mutants import Mutant, mutants_of
from soak.tally import Form, Tally

HERE = Path(__file__).parent
EXPLAINED = HERE / "mutation_explained.txt"
WORKERS = 2
LIMIT_S = 900.0

# Whose mutants, and the beginnings of the names of the tests that must notice them.
TESTS: dict[str, tuple[str, ...]] = {
    "dynamics.py": (
        "test_dynamics.py::test_an_arm",
        "test_dynamics.py::test_many",
        "test_dynamics.py::test_holding",
        "test_dynamics.py::test_one_link",
        "test_dynamics.py::test_pinocchio",
        "test_dynamics.py::test_gravity",
        "test_dynamics.py::test_inertia",
        "test_dynamics.py::test_coriolis",
        "test_dynamics.py::test_free_fall",
    ),
    "kernel.py": (
        "test_kernel.py",
        "test_network.py::test_exponential",
        "test_network.py::test_madam",
        "test_network.py::test_second",
    ),
    "descent.py": ("test_kernel.py::test_three",),
    "madam.py": (
        "test_network.py::test_madam",
        "test_network.py::test_first",
        "test_network.py::test_second",
        "test_network.py::test_a_gradient",
        "test_network.py::test_reference",
    ),
    "observer.py": (
        "test_observer.py",
        "test_control.py::test_observer",
    ),
    "inversion.py": (
        "test_control.py::test_command",
        "test_control.py::test_perfect",
        "test_control.py::test_cholesky",
        "test_control.py::test_slack",
        "test_control.py::test_torque",
        "test_control.py::test_closed_form",
    ),
    "recording.py": ("test_recorder.py", "test_recording.py"),
    "log/content.py": ("test_recorder.py", "test_recording.py"),
    "log/writer.py": ("test_log_writer.py",),
}

QUICK = ("dynamics.py", "madam.py", "observer.py", "inversion.py", "log/writer.py")

Key = tuple[str, str, str, str]


@dataclass(frozen=True)
class Verdict:
    """How the tests took a mutant.

    Args:
        outcome: "killed", "timed out", "survived", or "broken": it could not be put in place.
        why: the test that noticed, if one did.
    """

    mutant: Mutant
    outcome: str
    why: str
    seconds: float

    @property
    def noticed(self) -> bool:
        """Whether a test failed or did not end."""
        return self.outcome in ("killed", "timed out")


def run(form: Form, tally: Tally, folder: Path) -> None:
    """All mutants, or some of the files whose tests take little time."""
    mutants = [m for file in TESTS if form.long or file in QUICK for m in mutants_of(file)]
    if not form.long:
        mutants = sample(mutants, 40, form.seed)
    account(judge(mutants, TESTS, folder), explanations(EXPLAINED), tally, whole=form.long)


def sample(mutants: Sequence[Mutant], count: int, seed: int) -> list[Mutant]:
    """So many of them, by chance."""
    return random.Random(seed).sample(mutants, count)


def judge(
    mutants: Sequence[Mutant], tests: Mapping[str, Sequence[str]], folder: Path
) -> list[Verdict]:
    """Run the tests of each mutant's file against it."""
    shares = [mutants[k::WORKERS] for k in range(WORKERS)]
    started = [
        _start(share, tests, folder / f"worker{k}") for k, share in enumerate(shares) if share
    ]
    try:
        return [
            verdict
            for share, (process, out) in zip(filter(None, shares), started, strict=True)
            for verdict in _finish(share, process, out)
        ]
    finally:
        for process, _ in started:
            process.kill()


def _finish(share: Sequence[Mutant], process: subprocess.Popen[str], out: Path) -> list[Verdict]:
    printed, _ = process.communicate(timeout=LIMIT_S)
    found = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    assert len(found) == len(share), printed[-3000:]
    return [Verdict(mutant, **one) for mutant, one in zip(share, found, strict=True)]


def _start(
    share: Sequence[Mutant], tests: Mapping[str, Sequence[str]], folder: Path
) -> tuple[subprocess.Popen[str], Path]:
    folder.mkdir()
    orders, out = folder / "orders.json", folder / "verdicts.jsonl"
    orders.write_text(json.dumps([(m.file, m.source, list(tests[m.file])) for m in share]))
    path = os.pathsep.join([str(HERE.parent.parent), str(HERE.parent)])
    process = subprocess.Popen(
        [sys.executable, "-m", "soak.mutation_worker", str(orders), str(out)],
        env=os.environ | {"PYTHONPATH": path, "TMPDIR": str(folder)},
        cwd=HERE.parent.parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    return process, out


def account(
    verdicts: Sequence[Verdict], explained: Mapping[Key, str], tally: Tally, *, whole: bool
) -> None:
    """Count the verdicts; with all mutants, an explanation that explains nothing is lost too."""
    survived = {verdict.mutant.key for verdict in verdicts if verdict.outcome == "survived"}
    for verdict in verdicts:
        excused = verdict.outcome == "survived" and verdict.mutant.key in explained
        if verdict.noticed or excused:
            tally.survive()
        else:
            tally.lose(f"{verdict.outcome}: {verdict.mutant}")
    if whole:
        for key in explained.keys() - survived:
            tally.lose(f"explained, but no mutant that survives: {' | '.join(key)}")
    for file in dict.fromkeys(verdict.mutant.file for verdict in verdicts):
        tally.figure(file, _score([v for v in verdicts if v.mutant.file == file], explained))
    tally.figure("all", _score(verdicts, explained))


def _score(verdicts: Sequence[Verdict], explained: Mapping[Key, str]) -> dict[str, float]:
    counts = Counter(verdict.outcome for verdict in verdicts)
    excused = sum(v.outcome == "survived" and v.mutant.key in explained for v in verdicts)
    rest = len(verdicts) - excused
    return {
        "mutants": len(verdicts),
        "killed": counts["killed"],
        "timed out": counts["timed out"],
        "survived": len(verdicts) - counts["killed"] - counts["timed out"],
        "explained": excused,
        "score": round((counts["killed"] + counts["timed out"]) / rest, 4) if rest else 1.0,
    }


def explanations(path: Path) -> dict[Key, str]:
    """Why some mutants cannot be noticed.

    The file is made of blocks: a line `FILE FUNCTION`, lines `- before` and `+ after`, which may be
    several to one before, and the reason in the lines that follow. Lines after # are comments.
    """
    found: dict[Key, str] = {}
    for block in path.read_text().split("\n\n"):
        lines = [line for line in block.splitlines() if line and not line.startswith("#")]
        if not lines:
            continue
        file, _, function = lines[0].partition(" ")
        reason = " ".join(line for line in lines[1:] if line[:1] not in "-+")
        assert reason, f"no reason is given for {block}"
        before = ""
        for line in lines[1:]:
            if line.startswith("-"):
                before = line[2:]
            elif line.startswith("+"):
                found[file, function, before, line[2:]] = reason
    return found
