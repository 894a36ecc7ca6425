"""Row 12: a run in real time that does not get its machine tells so, and gets over it."""

from __future__ import annotations

import json
import math
import os
import random
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dnnmso_mj.reading import read_trace
from dnnmso_mj.trace import Trace
from soak import accounts
from soak.observed import STAMPS, START
from soak.pressure import burst, can_burst, load, stop
from soak.tally import Form, Tally

TESTS = Path(__file__).parents[1]
DAMPING = 3.0
SETTLED_S = 0.3  # after a load's end, by when the run must keep its deadlines again
BACKGROUND = 0.03  # of ticks, that a machine may miss more than before
BUSY = 0.2  # of ticks missed before any load of ours: the machine is busy with something else


@dataclass(frozen=True)
class Paced:
    """A run in a process of its own, observed.

    Args:
        dt: s.
        duration: s.
        watchdog: as the scenario names it.
        overrun: ms by tick that the controller computes too long; None: as it is.
        ordinary: without a right to a better priority.
    """

    dt: float
    duration: float
    watchdog: str
    overrun: dict[int, float] | None = None
    ordinary: bool = False

    @property
    def period(self) -> int:
        """Of a tick, in ns."""
        return round(self.dt * 1e9)

    @property
    def n_ticks(self) -> int:
        """Of the whole run."""
        return round(self.duration / self.dt)

    @contextmanager
    def running(self, folder: Path) -> Iterator[tuple[subprocess.Popen[str], int]]:
        """The process and when its tick 0 is due; waited for at the end."""
        folder.mkdir()
        words = [sys.executable, "-m", "soak.observed", str(folder)]
        words += ["--ordinary"] if self.ordinary else []
        if self.overrun is not None:
            words += ["--overrun", json.dumps(self.overrun)]
        sets = {
            "dt": self.dt,
            "duration": self.duration,
            "real_time.watchdog": self.watchdog,
            "real_time.damping": DAMPING,
        }
        words += ["--", "paper", "--real-time", "--no-plot", "--json", "--out", "run.mcap"]
        words += [word for key, value in sets.items() for word in ("--set", f"{key}={value}")]
        with (folder / "out.json").open("w") as out, (folder / "err.txt").open("w") as err:
            path = os.pathsep.join(filter(None, [str(TESTS), os.environ.get("PYTHONPATH")]))
            env = os.environ | {"PYTHONPATH": path}
            process = subprocess.Popen(
                words, cwd=folder, env=env, stdout=out, stderr=err, text=True
            )
        try:
            yield process, _start(folder, process)
            process.wait(self.duration + 60)
        finally:
            process.kill()
            process.wait()

    def judge(self, folder: Path, start: int, windows: list[tuple[int, int]]) -> list[str]:
        """All that is wrong with its log and its summary, in words."""
        trace = read_trace(folder / "run.mcap")
        said = json.loads((folder / "out.json").read_text())
        wrong = accounts.lost_ticks(trace, self.n_ticks, self.dt)
        if wrong:
            return wrong
        wrong += accounts.against_itself(trace, self.period)
        wrong += accounts.against_windows(trace, windows, start, self.period)
        wrong += accounts.against_watchdog(trace, self.watchdog, DAMPING)[0]
        total = int(np.count_nonzero(trace["deadline_missed"]))
        told = sum(miss["ticks"] for miss in said["real_time"]["misses"])
        if (told, said["metrics"]["deadline_misses"], said["status"]) != (total, total, "ok"):
            wrong.append(f"the summary has {told} misses of {total}, status {said['status']}")
        # The last tick's deadline is absolute: a run that drifts ends later than that.
        last_late = trace["wake_late_us"][-1] * 1e-6
        if said["wall_s"] > 0.02 + self.duration + last_late + 0.25:
            wrong.append(f"it took {said['wall_s']:.3f} s for {self.duration} s")
        return wrong


def _start(folder: Path, process: subprocess.Popen[str]) -> int:
    until = time.monotonic() + 120  # compiling included
    while not (folder / START).exists():
        assert process.poll() is None, (folder / "err.txt").read_text()[-300:]
        assert time.monotonic() < until, "the run does not start"
        time.sleep(0.005)
    return int((folder / START).read_text())


def sleep_to(t: float, start: int) -> None:
    """Wait until a run that started then is at its time t (s)."""
    time.sleep(max(0.0, (start - time.monotonic_ns()) * 1e-9 + t))


def missed_of(trace: Trace, first: float, after: float) -> float:
    """The part of ticks missed from one time (s) to another."""
    t = trace["t"]
    there = trace["deadline_missed"][(t >= first) & (t < after)]
    return float(there.mean()) if there.size else 0.0


def recovery(trace: Trace, loads: list[tuple[float, float]], background: float) -> list[str]:
    """Whether deadlines are kept again soon after each load (from, to in s of the run)."""
    wrong = []
    later = [begin for begin, _ in loads[1:]] + [math.inf]
    for (_, end), until in zip(loads, later, strict=True):
        missed = missed_of(trace, end + SETTLED_S, min(until, end + 2.0) - 0.01)
        if missed > background + BACKGROUND:
            wrong.append(f"after t = {end:.3f} s, {missed:.1%} of ticks are still missed")
    return wrong


def under_load(form: Form, tally: Tally, folder: Path, watchdog: str) -> None:
    """Ordinary priority: quiet, then every core, memory and disk busy, then quiet again."""
    quiet, busy, after = form.pick((0.7, 1.2, 1.3), (3.0, 6.0, 4.0))
    run = Paced(0.001, quiet + busy + after, watchdog, ordinary=True)
    work = folder / f"load-{watchdog}"
    with run.running(work) as (_, start):
        sleep_to(quiet, start)
        began = (time.monotonic_ns() - start) * 1e-9
        with load(folder):
            sleep_to(quiet + busy, start)
        ended = (time.monotonic_ns() - start) * 1e-9
    trace = read_trace(work / "run.mcap")
    before = missed_of(trace, 0.0, began)
    during = missed_of(trace, began, ended)
    tally.figure(f"missed before, under and after load, {watchdog} (%)", [
        round(100 * part, 2) for part in (before, during, missed_of(trace, ended + SETTLED_S, 1e9))
    ])  # fmt: skip
    wrong = run.judge(work, start, [])
    if before > BUSY:
        tally.leave_out(
            f"recovery at ordinary priority, watchdog {watchdog}",
            f"the machine was busy before: {before:.0%} of ticks were missed",
        )
    else:
        wrong += recovery(trace, [(began, ended)], before)
    if not during:
        wrong.append("the load made no tick late: nothing was tried")
    record(tally, f"load, watchdog {watchdog}, seed {form.seed}", wrong, run.n_ticks)


def interrupted(
    form: Form, tally: Tally, folder: Path, name: str, hold_up: Callable[[Any, float], Any]
) -> None:
    """The best priority there is, under load, and held up again and again from outside."""
    draw = random.Random(f"{name} {form.seed}")
    run = Paced(0.001, form.pick(3.5, 30.0), draw.choice(["hold", "zero", "damped"]))
    work = folder / name
    windows: list[tuple[int, int]] = []
    with run.running(work) as (process, start), load(folder):
        sleep_to(0.3, start)
        while (time.monotonic_ns() - start) * 1e-9 < run.duration - 1.5:
            windows.append(hold_up(process.pid, draw.uniform(0.05, 0.3)))
            time.sleep(draw.uniform(0.8, 1.1))  # of fewer ticks, two by chance would be 3 %
    trace = read_trace(work / "run.mcap")
    inside = accounts.within(windows, start, run.period, run.n_ticks)
    seconds = [((begin - start) * 1e-9, (end - start) * 1e-9) for begin, end in windows]
    wrong = run.judge(work, start, windows) + recovery(trace, seconds, 0.0)
    missed = trace["deadline_missed"].astype(bool)
    tally.figure(f"{name}: times", len(windows))
    tally.figure(f"{name}: ticks without the processor", int(inside.sum()))
    tally.figure(f"{name}: of these flagged", int((inside & missed).sum()))
    tally.figure(f"{name}: flagged elsewhere", int((missed & ~inside).sum()))
    if not inside.any():
        wrong.append("nothing was held up")
    record(tally, f"{name}, {len(windows)} times, seed {form.seed}", wrong, run.n_ticks)


def overrunning(form: Form, tally: Tally, folder: Path) -> None:
    """A controller that computes too long at known ticks, under load; each tick stamped."""
    draw = random.Random(f"overrun {form.seed}")
    run = Paced(0.002, form.pick(2.0, 12.0), "damped", {}, ordinary=True)
    ticks = draw.sample(range(50, run.n_ticks - 150), form.pick(8, 40))
    # Just in time, just too late, and much too late.
    run.overrun.update({k: draw.choice([0.5, 1.9, 2.1, 3.0, 40.0]) for k in ticks})  # type: ignore[union-attr]
    work = folder / "overrun"
    with run.running(work) as (_, start):
        sleep_to(run.duration / 3, start)
        with load(folder):
            sleep_to(2 * run.duration / 3, start)
    trace = read_trace(work / "run.mcap")
    wrong, unclear = accounts.against_stamps(trace, np.load(work / STAMPS), start, run.period)
    wrong += run.judge(work, start, [])
    missed = trace["deadline_missed"].astype(bool)
    too_long = [k for k, ms in (run.overrun or {}).items() if ms > 2.0]
    had_control = trace["compute_us"] > 0
    wrong += accounts.few(
        "computed too long and are not flagged",
        np.array([k for k in too_long if had_control[k] and not missed[k]]),
    )
    tally.figure("stamped ticks flagged", int(missed.sum()))
    tally.figure("stamped ticks that end within the stamps' width of their deadline", unclear)
    record(tally, f"overrun, seed {form.seed}", wrong, run.n_ticks)


def record(tally: Tally, what: str, wrong: list[str], n_ticks: int) -> None:
    """Count every tick that was accounted for, and all that was wrong."""
    for one in wrong:
        tally.lose(f"{what}: {one}")
    if not wrong:
        tally.survive(n_ticks)


def run(form: Form, tally: Tally, folder: Path) -> None:
    """See the module."""
    for watchdog in form.pick(("damped",), ("hold", "zero", "damped")):
        under_load(form, tally, folder, watchdog)
    interrupted(form, tally, folder, "SIGSTOP", stop)
    overrunning(form, tally, folder)
    if can_burst():
        interrupted(form, tally, folder, "bursts", lambda _, s: burst(1000 * s))
    else:
        tally.leave_out("every core taken above the run's priority", "no right to that priority")
