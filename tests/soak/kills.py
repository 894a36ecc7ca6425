"""SIGKILL at random instants: what is on disk is readable, right, and at most 0.1 s short.

Of a run that keeps to the wall clock 0.1 s is 0.1 s. Any other is held to 0.1 s of simulated time,
which is less of the clock's.
"""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from dnnmso_mj.loading import load_scenario
from dnnmso_mj.plots import save_figures
from dnnmso_mj.reading import log_info, read_trace, recover
from dnnmso_mj.resume import resume
from dnnmso_mj.run import run_logged
from dnnmso_mj.trace import Trace
from soak.forked import Process, kill, start, warm_up
from soak.killed import (
    BOUND_S,
    Loss,
    Page,
    check_log,
    check_ticks,
    loss,
    run_reporting,
    wait_for,
)
from soak.killed_sweeps import kill_sweeps
from soak.tally import Form, Tally

DT = 1e-3
FAST, OLD, PACED = ["duration=8"], ["duration=8", "seed=5"], ["duration=1.5"]


@dataclass(frozen=True)
class Known:
    """What undisturbed runs gave.

    Args:
        log: of the fast scenario.
        old: another log, to be replaced.
        fast, replaced, paced: their columns, and those of the paced scenario.
    """

    log: Path
    old: Path
    fast: Trace
    replaced: Trace
    paced: Trace


Trial = Callable[[Path, np.random.Generator], "Loss | None"]


def run(form: Form, tally: Tally, folder: Path) -> None:
    """All kinds of kills, spread over the whole life of what is killed."""
    warm_up()
    known = undisturbed(folder)
    kinds: dict[str, tuple[Trial, int]] = {
        "a run": (partial(kill_run, known, _life(known, folder)), form.pick(8, 70)),
        "a run in real time": (partial(kill_paced, known), form.pick(4, 36)),
        "run --force": (partial(kill_force, known), form.pick(4, 20)),
        "a run that begins its log": (partial(kill_at_birth, known), form.pick(3, 14)),
        "a run that ends its log": (partial(kill_at_end, known), form.pick(3, 14)),
        "resume": (partial(kill_resume, known), form.pick(2, 12)),
        "recover": (partial(kill_recover, known), form.pick(2, 10)),
        "figures": (partial(kill_figures, known), form.pick(2, 10)),
        "a new interpreter": (partial(kill_fresh, known), form.pick(1, 10)),
    }
    for number, (what, (trial, count)) in enumerate(kinds.items()):
        many(tally, folder, form.seed + 100 * number, what, trial, count)
    kill_sweeps(form, tally, folder / "sweeps")


def many(tally: Tally, folder: Path, seed: int, what: str, trial: Trial, count: int) -> None:
    """A trial many times, two at once, each in a folder of its own; losses become figures."""
    losses: list[Loss] = []

    def one(k: int) -> None:
        place = folder / f"{what.replace(' ', '-')}-{k}"
        place.mkdir()
        with tally.case(f"{what} {k}, seed {seed}"):
            cost = trial(place, np.random.default_rng([seed, k]))
            if cost is not None:
                losses.append(cost)
                assert cost.simulated_s <= BOUND_S + 1e-9, f"{cost.simulated_s:.3f} s are lost"
        shutil.rmtree(place, ignore_errors=True)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(one, range(count)))
    if losses:
        simulated = round(max(cost.simulated_s for cost in losses), 4)
        wall = round(max(cost.wall_s for cost in losses), 4)
        tally.figure(f"{what}: killed under way", len(losses))
        tally.figure(f"{what}: most lost (s, simulated)", simulated)
        tally.figure(f"{what}: most lost (s, wall)", wall)


def undisturbed(folder: Path) -> Known:
    """Runs that nobody kills."""
    runs = [
        run_logged(load_scenario("paper", sets), folder / f"{name}.mcap")
        for name, sets in (("fast", FAST), ("old", OLD), ("paced", PACED))
    ]
    fast, old, paced = runs
    return Known(fast.log, old.log, fast.trace, old.trace, paced.trace)


def _life(known: Known, folder: Path) -> float:
    """How long a forked run lives (s), from the beginning of its log to its end."""
    log = folder / "life.mcap"
    process = start(run_reporting, FAST, str(log), str(folder / "life"))
    wait_for(log.exists)
    began = time.monotonic()
    process.join()
    return time.monotonic() - began


def kill_run(known: Known, life: float, place: Path, rng: np.random.Generator) -> Loss | None:
    """At any instant of its life."""
    process, page, log = _begin(place, FAST)
    _wait(rng, log, life)
    return _cost(process, page, log, known.fast)


def kill_paced(known: Known, place: Path, rng: np.random.Generator) -> Loss | None:
    """At any instant of its life, by the wall clock."""
    process, page, log = _begin(place, PACED, real_time=True)
    _wait(rng, log, 1.7)
    return _cost(process, page, log, known.paced, paced=True)


def kill_at_birth(known: Known, place: Path, rng: np.random.Generator) -> Loss | None:
    """From where its folder is touched to some first blocks."""
    process, page, log = _begin(place / "new", FAST)
    assert wait_for(lambda: any((place / "new").iterdir())), "no log is begun"
    time.sleep(rng.uniform(0.0, 0.01))
    return _cost(process, page, log, known.fast)


def kill_at_end(known: Known, place: Path, rng: np.random.Generator) -> Loss | None:
    """While the metrics are computed and the end of the file is written."""
    process, page, log = _begin(place, FAST)
    wait_for(lambda: page.ticks == len(known.fast) or not process.is_alive())
    time.sleep(rng.uniform(0.0, 0.05))
    return _cost(process, page, log, known.fast)


def kill_force(known: Known, place: Path, rng: np.random.Generator) -> Loss | None:
    """The old log or the new one is there, at every instant."""
    log = place / "run.mcap"
    shutil.copyfile(known.old, log)
    process, page, _ = _begin(place, FAST, force=True)
    if rng.random() < 0.7:  # about where one takes the place of the other
        wait_for(lambda: any(path.name.startswith(".") for path in place.iterdir()), 5.0)
        time.sleep(rng.uniform(0.0, 0.01))
    else:
        time.sleep(rng.uniform(0.0, 0.5))
    killed = kill(process)
    if log_info(log).seed == 5:
        check_log(log, known.replaced, place / "whole.mcap")
        assert page.ticks == 0, "the new log is not there, though its run had begun"
        return None
    held = check_log(log, known.fast, place / "whole.mcap")
    return loss(page, held, killed, DT, len(known.fast), paced=False)


def kill_resume(known: Known, place: Path, rng: np.random.Generator) -> None:
    """The new log is as far as it got; the old one is as it was."""
    before = _digest(known.log)
    out = place / "resumed.mcap"
    process = start(resume, known.log, float(rng.uniform(0.0, 8.0)), (), out)
    time.sleep(rng.uniform(0.0, 1.2))
    kill(process)
    assert _digest(known.log) == before, "the log that was resumed has changed"
    if out.exists():
        check_log(out, known.fast, place / "whole.mcap")


def kill_recover(known: Known, place: Path, rng: np.random.Generator) -> None:
    """A recovered log is whole or not there."""
    torn, out = place / "torn.mcap", place / "out.mcap"
    torn.write_bytes(known.log.read_bytes()[:-9])
    process = start(recover, torn, out)
    time.sleep(rng.uniform(0.0, 0.3))
    kill(process)
    if out.exists():
        assert log_info(out).complete, "half a log"
        check_ticks(read_trace(out), known.fast)


def kill_figures(known: Known, place: Path, rng: np.random.Generator) -> None:
    """Every picture is whole; where there was one before, it is the old or the new."""
    names = ("run_tracking.png", "run_torque.png")
    for name in names:
        Image.new("RGB", (8, 8)).save(place / name)
    process = start(save_figures, known.paced, place, "run")
    time.sleep(rng.uniform(0.0, 1.5))
    kill(process)
    for picture in place.glob("[!.]*.png"):
        with Image.open(picture) as image:
            image.load()
    assert all((place / name).exists() for name in names), "a picture has gone"


def kill_fresh(known: Known, place: Path, rng: np.random.Generator) -> None:
    """From the first instruction of the interpreter on."""
    words = ["run", "paper", "--set", FAST[0], "--no-plot", "--out", str(place / "run.mcap")]
    process = subprocess.Popen(
        [sys.executable, "-m", "dnnmso_mj", *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    time.sleep(rng.uniform(0.0, 3.0))
    process.kill()
    process.wait()
    if (place / "run.mcap").exists():
        check_log(place / "run.mcap", known.fast, place / "whole.mcap")


def _begin(
    place: Path, sets: list[str], *, real_time: bool = False, force: bool = False
) -> tuple[Process, Page, Path]:
    place.mkdir(exist_ok=True)
    log, page = place / "run.mcap", place.parent / f"{place.name}.{place.parent.name}.page"
    shared = Page(page)
    return start(run_reporting, sets, str(log), str(page), real_time, force), shared, log


def _wait(rng: np.random.Generator, log: Path, life: float) -> None:
    """Until an instant of a run's life: now and then before its log is there, mostly after."""
    if rng.random() < 0.2:
        time.sleep(rng.uniform(0.0, 0.5))
    else:
        wait_for(log.exists)
        time.sleep(rng.uniform(0.0, life))


def _cost(
    process: Process, page: Page, log: Path, reference: Trace, *, paced: bool = False
) -> Loss | None:
    """Kill, read, and compare with what the loop had done; None: it had not begun."""
    killed = kill(process)
    if not log.exists():
        assert page.ticks == 0, f"{page.ticks} ticks were done, and no log is there"
        return None
    held = check_log(log, reference, log.with_name("whole.mcap"))
    if held == len(reference):
        return None
    return loss(page, held, killed, DT, len(reference), paced=paced)


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
