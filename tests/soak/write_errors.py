"""Disks that are full and writes that fail: a readable log, one error, and the run's summary."""

from __future__ import annotations

import errno
import json
import math
import os
import shutil
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from dnnmso_mj.loading import load_scenario
from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.reading import log_info, read_trace
from dnnmso_mj.run import run_logged
from dnnmso_mj.sweep.table import read_table
from dnnmso_mj.trace import Trace
from soak.failing import (
    failing_writes,
    few_files,
    fill,
    small_disk,
    small_files,
)
from soak.forked import Told, begin, command, ended, warm_up
from soak.killed import check_log, wait_for
from soak.killed_sweeps import untimed
from soak.tally import Form, Tally

SETS = ["--set", "duration=0.5"]
RUN = ["run", "paper", *SETS, "--no-plot"]
SWEEP = ["sweep", "paper", *SETS, "--seeds", "0:6", "--jobs", "1"]
TUNE = [
    *("tune", "paper", *SETS, "--controller", "pd", "--trials", "3", "--seeds", "0:1"),
    *("--jobs", "1"),
]
DISK = 4 * 2**20
SLOW = ("sweep", "tune", "replay")
NATIVE = ("replay",)  # Rerun's own code writes: no write of it can be made to fail here
CLOCK = ("compute_us_p50", "compute_us_p999", "deadline_misses")
ERRORS = (errno.ENOSPC, errno.EIO, errno.EDQUOT)


@dataclass(frozen=True)
class Bench:
    """What trials share: a finished log, its columns, a torn one, and a folder for each trial."""

    folder: Path
    log: Path
    torn: Path
    trace: Trace
    table: Any

    def place(self, name: str) -> Path:
        """A new empty folder."""
        place = self.folder / name
        place.mkdir()
        return place


def run(form: Form, tally: Tally, folder: Path) -> None:
    """Every write in turn, then full disks, limits, and what happens to a file under way."""
    warm_up()
    bench = prepare(folder)
    rng = np.random.default_rng([form.seed, 6])
    every_write(form, tally, bench, rng)
    full_disks(form, tally, bench, rng)
    limits(form, tally, bench, rng)
    places(tally, bench)
    read_only(form, tally, bench)
    under_way(tally, bench)


def prepare(folder: Path) -> Bench:
    """One run that nothing disturbs, and one sweep."""
    done = run_logged(load_scenario("paper", ["duration=0.5"]), folder / "whole.mcap")
    torn = folder / "torn.mcap"
    torn.write_bytes(done.log.read_bytes()[:-9])
    told = command([*SWEEP, "--out", folder / "all.parquet"], folder)
    assert told.status == 0, told.err
    table = untimed(read_table(folder / "all.parquet")[0])
    return Bench(folder, done.log, torn, done.trace, table)


def every_write(form: Form, tally: Tally, bench: Bench, rng: np.random.Generator) -> None:
    """The n-th write and all later ones fail, for every n (in short: some) of each command."""
    for name, (words, target) in commands(bench).items():
        if name in NATIVE or (name in SLOW and not form.long):
            continue
        place = bench.place(f"count-{name}")
        counter = bench.folder / f"count-{name}.txt"
        told = command(words(place / target), place, failing_writes, 0, 0, False, str(counter))
        assert told.status == 0, f"{name}: {told.err}"
        total = int(counter.read_text())
        tally.figure(f"{name}: writes", total)
        few = {1, total, int(rng.integers(1, total + 1))}
        trials = [
            (nth, int(rng.choice(ERRORS)), bool(rng.random() < 0.5))
            for nth in form.pick(sorted(few), list(range(1, total + 1))[:40])
        ]
        with ThreadPoolExecutor(2) as pool:
            list(pool.map(partial(one_write, form, tally, bench, name), trials))


def one_write(
    form: Form, tally: Tally, bench: Bench, name: str, trial: tuple[int, int, bool]
) -> None:
    """The n-th write fails, with an errno, torn or not at all."""
    nth, code, tear = trial
    words, target = commands(bench)[name]
    counter = bench.folder / f"count-{name}-{nth}.txt"
    what = f"{name}: write {nth} gives {errno.errorcode[code]}, torn {tear}"
    with tally.case(f"{what}, seed {form.seed}"):
        place = bench.place(f"{name}-{nth}")
        told = command(words(place / target), place, failing_writes, nth, code, tear, str(counter))
        if int(counter.read_text()) < nth:  # how many there are depends on the clock
            assert told.status == 0, told.err
        else:
            check(bench, name, told, place / target, os.strerror(code))
        shutil.rmtree(place)


def commands(bench: Bench) -> dict[str, tuple[Callable[[Path], list[Any]], str]]:
    """Commands that write, as words for an output, and its name."""
    return {
        "run": (lambda out: [*RUN, "--out", out], "run.mcap"),
        "run --json": (lambda out: [*RUN, "--json", "--out", out], "run.mcap"),
        "resume": (
            lambda out: ["resume", bench.log, "--at", "0.2", "--no-plot", "--out", out],
            "resumed.mcap",
        ),
        "recover": (lambda out: ["recover", bench.torn, "--out", out], "recovered.mcap"),
        "plot": (lambda out: ["plot", bench.log, "--out", out.parent], "whole_tracking.png"),
        "report": (lambda out: ["report", bench.log, "--out", out], "report.html"),
        "new": (lambda out: ["new", "mine", "--out", out], "mine.yaml"),
        "sweep": (lambda out: [*SWEEP, "--out", out], "sweep.parquet"),
        "tune": (lambda out: [*TUNE, "--out", out], "pd.yaml"),
        "replay": (lambda out: ["replay", bench.log, "--save", out], "run.rrd"),
    }


def check(bench: Bench, name: str, told: Told, out: Path, why: str) -> None:
    """What must hold of a command that could not write.

    Raises:
        AssertionError: something does not.
    """
    assert told.is_one_error, f"status {told.status}: {told.err.strip()[-300:]}"
    assert out.parent.name in told.err, f"the error names no file: {told.err}"
    assert why in told.err, f"the error does not say {why!r}: {told.err}"
    litter = [path.name for path in out.parent.iterdir() if path.name.startswith(".")]
    assert not litter, f"left behind: {litter}"
    if name.startswith("run") or name == "resume":
        check_run(bench, told, out, as_json="--json" in name)
    else:
        check_whole(out.parent)
        assert name != "recover" or not out.exists(), "half a recovered log"


def check_run(bench: Bench, told: Told, out: Path, *, as_json: bool) -> None:
    """The log holds the first ticks, and the summary is of them.

    Raises:
        AssertionError: it does not.
    """
    if not out.exists():
        assert not told.out, f"no log is there, and a summary is: {told.out}"
        return
    held = check_log(out, bench.trace, bench.folder / f"again-{out.parent.name}.mcap")
    if not as_json:
        assert ": failed" in told.out, f"no summary: {told.out!r}"
        assert "rmse" in told.out, f"no metrics: {told.out!r}"
        return
    summary = json.loads(told.out)
    assert summary["status"] == "failed", summary["status"]
    assert str(out) in summary["reason"], summary["reason"]
    expected = compute_metrics(read_trace(out)) if held else {}
    for metric, value in expected.items():
        if metric not in CLOCK:
            assert summary["metrics"][metric] == value, f"{metric} is not of the ticks in the log"


def check_whole(folder: Path) -> None:
    """What has its final name is whole.

    Raises:
        AssertionError: something is not.
    """
    for picture in folder.glob("*.png"):
        with Image.open(picture) as image:
            image.load()
    for page in folder.glob("*.html"):
        assert page.read_text().rstrip().endswith("</html>"), f"half of {page.name}"
    for table in folder.glob("*.parquet"):
        read_table(table)
    for scenario in folder.glob("mine.yaml"):
        load_scenario(str(scenario))
    for recording in folder.glob("*.rrd"):
        raise AssertionError(f"{recording.name} is there")


def full_disks(form: Form, tally: Tally, bench: Bench, rng: np.random.Generator) -> None:
    """A disk with less room than a command needs."""
    with small_disk(bench.folder / "disk", DISK) as disk:
        if disk is None:
            tally.leave_out("full disks", "no small disk can be mounted here")
            return
        for name, (words, target) in commands(bench).items():
            slow = name in SLOW
            if name == "tune" and not form.long:
                continue
            need = _needed(disk, words, target)
            for k in range(form.pick(1, 5 if slow else 14)):
                left = int(rng.integers(0, max(1, need // 4096))) * 4096
                with tally.case(f"{name} with {left} bytes left, seed {form.seed}"):
                    place = disk / f"{name.replace(' ', '-')}-{k}"
                    place.mkdir()
                    fill(disk, left)
                    work = bench.place(f"disk-{name}-{k}")
                    told = command(words(place / target), work)
                    check(bench, name, told, place / target, "")
                    (disk / "ballast").unlink()
                    if name in ("sweep", "tune"):
                        go_on(bench, name, words(place / target), work)
                for left_over in disk.iterdir():
                    shutil.rmtree(left_over) if left_over.is_dir() else left_over.unlink()


def _needed(disk: Path, words: Callable[[Path], list[Any]], target: str) -> int:
    """Bytes that a command writes."""
    place = disk / "measured"
    place.mkdir()
    told = command(words(place / target), place.parent.parent)
    assert told.status == 0, told.err
    need = sum(path.stat().st_blocks * 512 for path in place.iterdir())
    shutil.rmtree(place)
    return need


def go_on(bench: Bench, name: str, words: list[Any], work: Path) -> None:
    """With room again, `--resume` completes what was begun.

    Raises:
        AssertionError: it does not.
    """
    told = command([*words, "--resume"], work)
    assert told.status == 0, f"--resume: {told.err}"
    if name == "sweep":
        table = untimed(read_table(Path(words[-1]))[0])
        assert table.equals(bench.table), "the table is another one"


def limits(form: Form, tally: Tally, bench: Bench, rng: np.random.Generator) -> None:
    """Files that may not grow, at any byte; and too few that may be open."""
    size = bench.log.stat().st_size
    for name in ("run", "run --json", "resume", "recover"):
        words, target = commands(bench)[name]
        for k in range(form.pick(1, 12)):
            most = int(rng.integers(1, size - 2000))
            with tally.case(f"{name}, files of {most} bytes at most, seed {form.seed}"):
                place = bench.place(f"limit-{name}-{k}")
                told = command(words(place / target), place, small_files, most)
                if len(told.out) + len(told.err) >= most:
                    continue  # no room to say anything
                check(bench, name, told, place / target, "File too large")
                shutil.rmtree(place)
    for name in ("run", "resume", "recover", "plot", "report", "new"):
        words, target = commands(bench)[name]
        for more in form.pick((0,), range(8)):
            with tally.case(f"{name}, {more} more files may be open"):
                place = bench.place(f"open-{name}-{more}")
                told = command(words(place / target), place, few_files, more)
                if told.status != 0:
                    assert told.is_one_error, f"status {told.status}: {told.err[-300:]}"
                    assert "Too many open files" in told.err, told.err
                check_whole(place)
                if (place / target).suffix == ".mcap" and (place / target).exists():
                    check_log(place / target, bench.trace, place / "again.mcap")


def places(tally: Tally, bench: Bench) -> None:
    """Where nothing can be written."""
    outs = {
        "/dev/full": Path("/dev/full"),
        "in /dev/full": Path("/dev/full/run.mcap"),
        "in /proc": Path("/proc/run.mcap"),
        "a folder": bench.place("a-folder"),
        "a name too long": bench.folder / ("n" * 255 + ".mcap"),
    }
    for what, out in outs.items():
        for force in ([], ["--force"]):
            with tally.case(f"run --out {what} {force}"):
                work = bench.place(f"work-{what.replace('/', '-')}-{len(force)}")
                told = command([*RUN, "--out", out, *force], work)
                assert told.is_one_error, f"status {told.status}: {told.err[-300:]}"
                assert str(out)[:60] in told.err, told.err
                assert not told.out, told.out
                assert not list(work.iterdir()), "something is left behind"


def read_only(form: Form, tally: Tally, bench: Bench) -> None:
    """A disk that may be read only, for every command."""
    with small_disk(bench.folder / "read-only", DISK) as disk:
        if disk is None or os.system(f"mount -o remount,ro {disk}") != 0:
            tally.leave_out("a disk to be read only", "none can be mounted here")
            return
        for name, (words, target) in commands(bench).items():
            if name in SLOW and not form.long:
                continue
            with tally.case(f"{name} on a disk that may be read only"):
                work = bench.place(f"ro-{name}")
                told = command(words(disk / target), work)
                assert told.is_one_error, f"status {told.status}: {told.err[-300:]}"
                assert "Read-only file system" in told.err, told.err


def under_way(tally: Tally, bench: Bench) -> None:
    """The file, or its folder, is removed or renamed while the run writes it."""

    def rename(out: Path) -> None:
        out.rename(out.with_name("moved.mcap"))

    def replace(out: Path) -> None:
        out.unlink()
        out.write_text("something else")

    acts: dict[str, Callable[[Path], object]] = {
        "removed": Path.unlink,
        "renamed": rename,
        "replaced": replace,
        "its folder removed": lambda out: shutil.rmtree(out.parent),
    }
    for what, act in acts.items():
        with tally.case(f"a log that is {what} while it is written"):
            work, out = bench.place(f"work {what}"), bench.place(what) / "run.mcap"
            process = begin([*RUN, "--real-time", "--json", "--out", out], work)
            assert wait_for(out.exists), "no log"
            time.sleep(0.2)
            act(out)
            told = ended(process, work)
            assert told.is_one_error, f"status {told.status}: {told.err[-300:]}"
            assert str(out) in told.err, told.err
            summary = json.loads(told.out)
            assert summary["status"] == "failed", summary["status"]
            assert math.isfinite(summary["metrics"]["rmse"]), "no metrics"
            if what == "renamed":
                moved = log_info(out.with_name("moved.mcap"))
                assert moved.complete, "what was moved away is not whole"
