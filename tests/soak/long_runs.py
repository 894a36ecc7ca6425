"""Row 11: an hour in one run, and ten thousand runs in one process."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from mcap.records import Channel

from dnnmso_mj import load_scenario, run_logged
from dnnmso_mj.log.messages import Messages
from dnnmso_mj.log.prefix import Prefix
from dnnmso_mj.log.step_message import StepFormat, layout_of
from dnnmso_mj.logged import LoggedRun
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.simulation import Simulation
from dnnmso_mj.trace import Event
from soak.errands import Errands
from soak.resources import (
    MIB,
    Sample,
    described,
    forget_peak,
    judge,
    own_memory,
    peak_memory,
    resident_memory,
    sample,
    slope,
)
from soak.tally import Form, Tally

Array = np.ndarray

NS_PER_S = 1_000_000_000
# The paper's network goes on growing, and its loop diverges after some minutes; not a frozen one.
HOUR = ("paper", ("events=[{kind: freeze, at: 30.0}]",))
INDEX_BYTES = 4.0  # a tick, of the log's index, which is written at its end
KEPT_BYTES = 16.0  # a tick, of metrics: percentiles need all of a column
FIXED_MIB = 160.0  # whatever the length: a block of ticks and its copies, matplotlib
RUN_MIB, RUN_OBJECTS = 1e-3, 0.5  # a run


def run(form: Form, tally: Tally, folder: Path) -> None:
    """Many short runs of every sort; then a long one with its log, metrics and figures."""
    with _temporary_files_in(folder / "tmp"):
        many(form, tally, folder)
        hour(form, tally, folder)
        unread_clock(form, tally)


def hour(form: Form, tally: Tally, folder: Path) -> None:
    """One run of an hour (of a minute in the short form), as `dnnmso run` does it."""
    name, sets = HOUR
    scenario = load_scenario(name, [*sets, f"duration={form.pick(60, 3600)}", f"seed={form.seed}"])
    forget_peak()
    before = resident_memory()
    done, samples = logged(scenario, folder / "hour.mcap", tally)
    with tally.case("an hour's run ends well, with all of its ticks"):
        assert (done.info.status, done.ticks) == ("ok", scenario.n_ticks), done.info.reason
    grown = (samples[-1].memory - samples[len(samples) // 10].memory) * MIB
    allowed = INDEX_BYTES * done.ticks + 4 * MIB
    tally.figure("memory grown within the run (MiB)", round(grown / MIB, 2))
    tally.figure("the same, bytes a tick", round(grown / done.ticks, 2))
    with tally.case("memory is flat within the run"):
        assert grown <= allowed, f"{grown / MIB:.1f} MiB more; allowed {allowed / MIB:.1f}"
    with tally.case("figures of the run"):
        from dnnmso_mj.plots import save_figures

        assert save_figures(done.drawn(), folder, "hour")
    bound = FIXED_MIB * MIB + KEPT_BYTES * done.ticks
    peak = peak_memory() - before
    tally.figure("simulated (s)", done.ticks * scenario.dt)
    tally.figure("log (MB)", round(done.log.stat().st_size / 1e6, 1))
    tally.figure(
        "wall time of the loop, a tick (µs)", round(1e6 * done.info.wall_s / done.ticks, 1)
    )
    tally.figure("peak above the start, with metrics and figures (MiB)", round(peak / MIB, 1))
    with tally.case("metrics and figures do not take the run into memory"):
        assert peak <= bound, f"peak {peak / MIB:.0f} MiB; allowed {bound / MIB:.0f}"
    with tally.case("time does not drift"):
        tally.figure("ticks whose time was compared", check_times(done.log, scenario.dt))


def logged(scenario: Scenario, out: Path, tally: Tally) -> tuple[LoggedRun, list[Sample]]:
    """A run with its log, and samples taken on the way, each hundredth of it."""
    samples: list[Sample] = []
    every, ticks = scenario.n_ticks // 100, 0

    def progress(done: int) -> None:
        nonlocal ticks
        ticks += done
        if ticks // every > (ticks - done) // every:
            samples.append(_light(ticks))

    started = time.monotonic()
    done = run_logged(scenario, out, progress=progress)
    tally.figure("wall time of run and metrics (s)", round(time.monotonic() - started, 1))
    return done, samples


def _light(ticks: int) -> Sample:
    """Memory alone: going through all objects takes longer than some ticks."""
    return Sample(ticks, own_memory() / MIB, 0, 0, 0, 0, 0, 0, 0)


def check_times(log: Path, dt: float) -> int:
    """Compare t and log_time of every message with k·dt; returns how many there are.

    Raises:
        AssertionError: t is not k·dt rounded once, or log_time not that in whole nanoseconds.
    """
    period = round(dt * NS_PER_S)
    assert period == dt * NS_PER_S, f"dt = {dt}: no whole nanoseconds"
    step, done = -1, 0
    for record in Prefix(log):
        if isinstance(record, Channel) and record.topic == "/step":
            step = record.id
        if not isinstance(record, Messages) or record.channel_id != step:
            continue
        layout = layout_of(record.data[0].tobytes())
        ticks = np.arange(done, done + len(record))
        t = StepFormat(layout).decode(record.data)[:, layout.slices["t"]][:, 0]
        wrong = np.flatnonzero(t != ticks * dt)
        assert not wrong.size, f"tick {ticks[wrong[0]]}: t = {float(t[wrong[0]])!r}"
        ns = record.time_ns.astype(np.int64)
        wrong = np.flatnonzero((ns != ticks * period) | (record.sequence != ticks))
        assert not wrong.size, f"tick {ticks[wrong[0]]}: log_time {ns[wrong[0]]} ns"
        done += len(record)
    return done


class _Clock:
    """A recorder that keeps rows, and may put MuJoCo's clock wrong on the way."""

    block, keeps_snapshots = 250, False

    def __init__(self, simulation: Simulation, wrong: bool) -> None:
        self._simulation, self._wrong = simulation, wrong
        self.rows: list[Array] = []

    def append(self, rows: Array) -> None:
        """Keep rows."""
        self.rows.append(rows.copy())
        if self._wrong:
            self._simulation.plant.data.time = -1e6 * len(self.rows)

    def event(self, event: Event) -> None:
        """Events are not looked at."""

    def snapshot(self, name: str, t: float, arrays: object) -> None:
        """Nor snapshots."""


def unread_clock(form: Form, tally: Tally) -> None:
    """MuJoCo adds dt up, which drifts; nothing reads its clock."""
    n_ticks = form.pick(20_000, 200_000)
    sets = [f"duration={n_ticks / 1000}", "controller={kind: pd}", f"seed={form.seed}"]
    scenario = load_scenario("paper", sets)
    rows, drift = [], 0.0
    for wrong in (False, True):
        simulation = Simulation(scenario, Mjcf.read(find_model(scenario.plant.model)))
        clock = _Clock(simulation, wrong)
        simulation.run(clock)
        rows.append(np.concatenate(clock.rows))
        if not wrong:
            drift = abs(simulation.plant.data.time - n_ticks * scenario.dt)
    tally.figure(f"drift of MuJoCo's own clock after {n_ticks} ticks (s)", drift)
    timed = [simulation.layout.slices[name].start for name in ("compute_us", "wake_late_us")]
    with tally.case("nothing reads MuJoCo's clock"):
        same = [np.delete(each, timed, axis=1).tobytes() for each in rows]
        assert same[0] == same[1], "with MuJoCo's clock put wrong, the run is another one"


def many(form: Form, tally: Tally, folder: Path) -> None:
    """Thousands of short runs of every sort in this process."""
    n_runs = form.pick(150, 10_000)
    errands = Errands(folder / "many", form.seed)
    errands.each()
    samples = repeat(errands.next, n_runs, form.pick(15, 50))
    tally.survive(errands.right)
    for wrong in errands.wrong:
        tally.lose(wrong)
    tally.figure("short runs", n_runs)
    tally.figure("of each sort", dict(errands.counts))
    tally.figure("memory grown per 1000 runs (MiB)", round(1000 * slope(samples, "memory"), 3))
    tally.figure("objects grown per 1000 runs", round(1000 * slope(samples, "objects"), 1))
    tally.figure("first and last sample", described(samples[len(samples) // 2], samples[-1]))
    judge(samples, tally, unit="run", memory=RUN_MIB, objects=RUN_OBJECTS)


def repeat(errand: Callable[[], None], count: int, samples: int) -> list[Sample]:
    """Do something again and again, and sample this process on the way."""
    out = []
    for k in range(count):
        if k % max(1, count // samples) == 0:
            out.append(sample(k))
        errand()
    return [*out, sample(count)]


@contextmanager
def _temporary_files_in(folder: Path) -> Iterator[None]:
    folder.mkdir()
    before, tempfile.tempdir = tempfile.tempdir, str(folder)
    try:
        yield
    finally:
        tempfile.tempdir = before
