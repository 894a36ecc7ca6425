"""A step of docs/experiments.py: run it, unless its result is there, and keep what it says.

A step that is finished for the same command, code and files is not run again; one that was
interrupted goes on where its command can.
"""

from __future__ import annotations

import hashlib
import json
import shlex
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow.parquet as pq

from dnnmso_mj.provenance import git_commit
from dnnmso_mj.sources import sources_digest

ROOT = Path(__file__).parents[1]

DROPPED = {  # of a short result: paths, the clock, and what stands beside it in the whole one
    *("out", "storage", "files", "rows", "rows_kept", "trials_kept", "jobs", "engine"),
    *("wall_s", "ticks_per_s", "compute_us_p50", "compute_us_p999", "deadline_misses"),
}
TAILS = ("rmse_steady", "tau_peak", "tau_chatter")
FAILURES = 3  # that a short result lists


class Step(NamedTuple):
    """One command, and the files whose change makes its result another one."""

    name: str
    command: tuple[str, ...]
    seconds: float
    reads: tuple[Path, ...] = ()
    resumes: bool = True


def run(step: Step, whole: Path, short: Path) -> bool:
    """Run a step unless its result is there; whether it is there now.

    Args:
        whole, short: folders of whole results and of short ones.
    """
    result = ROOT / whole / f"{step.name}.out"
    started = result.with_suffix(".started")
    stamp = _stamp(step)
    print(f"\n## {step.name}\n$ {shlex.join(step.command)}", flush=True)
    if result.exists() and _first_line(result) == stamp:
        print("finished before", flush=True)
        return True
    begun = f"{stamp} {git_commit()}"
    again = started.exists() and started.read_text() == begun
    result.parent.mkdir(parents=True, exist_ok=True)
    started.write_text(begun)
    way = ("--resume" if again else "--force",) if step.resumes else ()
    print(f"estimate {step.seconds:.0f} s", flush=True)
    since = time.perf_counter()
    program = {"dnnmso": ("-m", "dnnmso_mj"), "python": ()}[step.command[0]]
    done = subprocess.run(  # noqa: S603
        [sys.executable, *program, *step.command[1:], *way],
        cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False,
    )  # fmt: skip
    wall = time.perf_counter() - since
    if done.returncode != 0:
        print(f"FAILED with status {done.returncode} after {wall:.0f} s", flush=True)
        return False
    result.write_text(f"{stamp}\n{done.stdout}")
    _write_short(step, done.stdout, ROOT / short)
    print(f"took {wall:.0f} s", flush=True)
    return True


def _stamp(step: Step) -> str:
    """Of the command, the code and the files that it reads."""
    digest = hashlib.sha256(f"{shlex.join(step.command)}\0{sources_digest()}".encode())
    for file in step.reads:
        path = ROOT / file
        digest.update(path.read_bytes() if path.exists() else b"none")
    return digest.hexdigest()


def _first_line(file: Path) -> str:
    with file.open() as stream:
        return stream.readline().strip()


def _write_short(step: Step, output: str, folder: Path) -> None:
    """What docs quote: JSON with few digits, or the text that a script prints."""
    folder.mkdir(parents=True, exist_ok=True)
    command = shlex.join(step.command)
    if "--json" in step.command:
        short = {"command": command, "result": shortened(json.loads(output))}
        if step.command[1] in {"compare", "sweep"}:
            short["tails"] = tails(Path(step.command[step.command.index("--out") + 1]))
        text = json.dumps(short, indent=1, sort_keys=True, ensure_ascii=False)
        (folder / f"{step.name}.json").write_text(f"{text}\n")
    elif step.command[0] == "python":
        (folder / f"{step.name}.md").write_text(f"`{command}`\n\n{output}")


def tails(file: Path) -> dict[str, dict[str, dict[str, float | None]]]:
    """The 99th percentile and the largest of some metrics by controller; null: of a lost run.

    Args:
        file: a table of runs, relative to the checkout.
    """
    table = pq.read_table(ROOT / file)
    names = np.array(table["controller"].to_pylist())
    found: dict[str, dict[str, dict[str, float | None]]] = {}
    for name in sorted(set(names)):
        found[name] = {}
        for metric in TAILS:
            values = table[metric].to_numpy(zero_copy_only=False)[names == name].astype(float)
            values = np.where(np.isnan(values), np.inf, values)
            p99 = float(np.quantile(values, 0.99, method="higher"))
            found[name][metric] = {"p99": _finite(p99), "max": _finite(float(values.max()))}
    return found


def _finite(value: float) -> float | None:
    return float(f"{value:.4g}") if np.isfinite(value) else None


def shortened(value: Any) -> Any:
    """A result without paths and times, numbers in four digits, and few of the failures."""
    if isinstance(value, dict):
        kept = {key: below for key, below in value.items() if key not in DROPPED}
        if "failures" in kept:
            kept["failures"] = kept["failures"][:FAILURES]
        return {key: shortened(below) for key, below in kept.items()}
    if isinstance(value, list):
        return [shortened(below) for below in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value
