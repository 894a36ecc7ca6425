"""Row 7: whatever is read from outside gives what it holds or a typed error, soon and in little.

Four targets, each in processes of its own: hypothesis makes cases that are nearly valid, then
atheris goes on from real files, with those cases first that reach new code. See `fuzz_guard` for
what counts as lost.
"""

from __future__ import annotations

import base64
import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

from soak.fuzz_guard import Failure, Found, tried_now
from soak.proof import TESTS
from soak.tally import Form, Tally

AT_ONCE = 2
STALLED_S, START_S = 60.0, 300.0  # with one case, and before the first
DEATHS = 5  # of a process of one job, before it is given up
TOLD = 20  # cases of one way to fail that are listed


@dataclass(frozen=True)
class Job:
    """A target, and how many cases of it are tried in one process.

    Args:
        target: as `fuzz_process` names it.
        generated, mutated: cases by hypothesis, and by atheris.
        seed: of both.
    """

    target: str
    generated: int
    mutated: int
    seed: int = 0

    @property
    def cases(self) -> int:
        """All of them."""
        return self.generated + self.mutated


SHORT = (
    Job("scenarios", 150, 650),
    Job("logs", 300, 2200),
    Job("models", 300, 2700),
    Job("sets", 500, 6500),
)
LONG = (
    Job("sets", 4000, 316_000),
    Job("sets", 4000, 316_000),
    Job("scenarios", 4000, 66_000),
    Job("logs", 4000, 176_000),
    Job("models", 4000, 116_000),
)


def run(form: Form, tally: Tally, folder: Path) -> None:
    if find_spec("atheris") is None:
        tally.leave_out("all of it", "atheris is not installed")
        return
    jobs = [
        replace(job, seed=1000 * form.seed + 100 * k)
        for k, job in enumerate(form.pick(SHORT, LONG))
    ]
    folders = [folder / f"{job.target}-{k}" for k, job in enumerate(jobs)]
    with ThreadPoolExecutor(AT_ONCE) as threads:
        found = list(threads.map(fuzz, jobs, folders))
    for target in dict.fromkeys(job.target for job in jobs):
        parts = [part for job, part in zip(jobs, found, strict=True) if job.target == target]
        count(target, parts, tally)
    for job, part in zip(jobs, found, strict=True):
        if part.cases < job.cases:
            tally.leave_out(
                f"{job.target}: {job.cases - part.cases:,} of {job.cases:,} cases",
                "the process that tries them ended too often",
            )


def count(target: str, parts: list[Found], tally: Tally) -> None:
    """Put what was found into the scorecard."""
    tally.survive(sum(part.cases - part.lost for part in parts))
    for part in parts:
        for failure in part.failures.values():
            for _ in range(min(failure.cases, TOLD)):
                tally.lose(f"{target}: {failure.what}; base64 {failure.input[:2000]}")
    tally.figure(f"{target}: cases", sum(part.cases for part in parts))
    tally.figure(f"{target}: accepted", sum(part.accepted for part in parts))
    tally.figure(f"{target}: slowest (s)", round(max(part.slowest_s for part in parts), 3))
    tally.figure(f"{target}: largest (MB)", round(max(part.largest_mb for part in parts), 1))


def fuzz(job: Job, folder: Path, environment: Mapping[str, str] | None = None) -> Found:
    """Try all cases of a job; a process that dies of one is started again behind it."""
    total = Found()
    left = job
    for death in range(DEATHS):
        place = folder / str(death)
        place.mkdir(parents=True)
        why = _try(left, place, environment or {})
        found = _found(place)
        if why:
            cases, data = tried_now(place / "now.bin") if (place / "now.bin").exists() else (0, b"")
            found.cases = max(cases, found.cases)
            encoded = base64.b64encode(data).decode()
            found.failures[why] = Failure(f"{why}: {_last_words(place)}", encoded, 1)
            found.accepted = found.cases - found.refused - _failed(found)
        total = _sum(total, found)
        if not why or total.cases >= job.cases:
            break
        left = Job(job.target, 0, job.cases - total.cases, job.seed + death + 1)
    return total


def _try(job: Job, folder: Path, environment: Mapping[str, str]) -> str:
    """Run the process; why it did not reach its end, "" if it did."""
    words = [job.target, str(folder), str(job.seed), str(job.generated), str(job.mutated)]
    with (folder / "said.txt").open("wb") as said:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "soak.fuzz_process", *words],
            env={**os.environ, "PYTHONHASHSEED": "0", "PYTHONPATH": _path(), **environment},
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=said,
        )
        try:
            return _watch(process, folder / "now.bin")
        finally:
            process.kill()
            process.wait()


def _path() -> str:
    before = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    return os.pathsep.join([str(TESTS), str(TESTS.parent), *filter(None, before)])


def _watch(process: subprocess.Popen[bytes], note: Path) -> str:
    """Wait for its end, or until it stays with one case for too long."""
    cases, since = -1, time.monotonic()
    while True:
        try:
            status = process.wait(0.5)
        except subprocess.TimeoutExpired:
            now = tried_now(note)[0] if note.exists() and note.stat().st_size else 0
            if now != cases:
                cases, since = now, time.monotonic()
            elif time.monotonic() - since > (STALLED_S if cases else START_S):
                return f"hung for {time.monotonic() - since:.0f} s"
        else:
            return f"the process ended with status {status}" if status else ""


def _found(folder: Path) -> Found:
    file = folder / "found.json"
    return Found.from_json(json.loads(file.read_text())) if file.exists() else Found()


def _last_words(folder: Path) -> str:
    lines = (folder / "said.txt").read_text(errors="replace").splitlines()
    telling = [line for line in lines if "ERROR" in line or "Error" in line or "Fatal" in line]
    return (telling or lines or ["it said nothing"])[-1][:200]


def _failed(found: Found) -> int:
    return sum(failure.cases for failure in found.failures.values())


def _sum(one: Found, other: Found) -> Found:
    failures = {**one.failures}
    for key, failure in other.failures.items():
        failures[key] = replace(
            failure, cases=failure.cases + getattr(failures.get(key), "cases", 0)
        )
    return Found(
        cases=one.cases + other.cases,
        accepted=one.accepted + other.accepted,
        refused=one.refused + other.refused,
        slowest_s=max(one.slowest_s, other.slowest_s),
        largest_mb=max(one.largest_mb, other.largest_mb),
        failures=failures,
    )
