"""A row in a process, and its short form as a test."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from soak.rows import Row, row_of
from soak.tally import Form, Tally

TESTS = Path(__file__).parents[1]
SHOWN = 20  # things lost or let in that a result lists


def measure(which: Row, form: Form, folder: Path) -> dict[str, Any]:
    """Run a row here; what it found, as JSON. A row that breaks off has lost."""
    tally = Tally()
    started = time.monotonic()
    try:
        importlib.import_module(f"soak.{which.module}").run(form, tally, folder)
    except Exception:
        traceback.print_exc()
        tally.lose(f"broke off: {traceback.format_exc(limit=-1).strip().splitlines()[-1]}")
    return result(which, form, tally, time.monotonic() - started)


def measure_apart(which: Row, form: Form) -> dict[str, Any]:
    """Run a row in a process of its own, which it may bring down, and which ends in time."""
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="dnnmso-soak-") as scratch:
        out = Path(scratch) / "result.json"
        command = [
            sys.executable,
            "-m",
            "soak",
            "--row",
            str(which.number),
            "--seed",
            str(form.seed),
        ]
        command += ["--into", str(out), *(() if form.long else ("--short",))]
        tally = Tally()
        path = os.pathsep.join(filter(None, [str(TESTS), os.environ.get("PYTHONPATH")]))
        process = subprocess.Popen(
            command,
            cwd=TESTS.parent,
            env=os.environ | {"PYTHONPATH": path},
            start_new_session=True,
        )
        try:
            status = process.wait(which.limit_s)
        except subprocess.TimeoutExpired:
            tally.lose(f"not done after {which.limit_s:g} s")
        else:
            if out.exists():
                found: dict[str, Any] = json.loads(out.read_text())
                return found
            tally.lose(f"its process ended with status {status}")
        finally:
            _end(process)
        return result(which, form, tally, time.monotonic() - started)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a row's process: first asked to, so that it ends those that it put into other groups."""
    for ask, patience in ((signal.SIGTERM, 10.0), (signal.SIGKILL, None)):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, ask)
        with suppress(subprocess.TimeoutExpired):
            process.wait(patience)


def result(which: Row, form: Form, tally: Tally, seconds: float) -> dict[str, Any]:
    """A tally as JSON, with what it is of."""
    found = {
        "row": which.number,
        "title": which.title,
        "form": "long" if form.long else "short",
        "seed": form.seed,
        "tried": tally.tried,
        "passed": tally.passed,
        **asdict(tally),
        "seconds": round(seconds, 1),
    }
    for key in ("lost", "let_in"):
        listed = found[key]
        found[key] = len(listed)
        found[f"{key}_first"] = list(dict.fromkeys(listed))[:SHOWN]
    return found


def prove(
    number: int,
    folder: Path,
    seed: int = 0,
    *,
    apart: bool = False,
    may_be_left_out: tuple[str, ...] = (),
) -> dict[str, Any]:
    """The short form of a row, as a test: fails where anything is lost, let in or not run.

    Args:
        number: of the row.
        folder: for what it writes.
        seed: of its random choices.
        apart: whether in a process of its own, where other tests would be in the way.
        may_be_left_out: beginnings of what a machine may not let be run.
    """
    form = Form(seed=seed)
    found = measure_apart(row_of(number), form) if apart else measure(row_of(number), form, folder)
    whole = all(what.startswith(may_be_left_out) for what in found["not_run"])
    held = found["tried"] > 0 and not (found["lost"] or found["let_in"])
    assert held, json.dumps(found, indent=1)
    assert whole, json.dumps(found, indent=1)
    return found
