"""Two writers of one name: one has it, the other is told so, and nothing is mixed."""

from __future__ import annotations

import os
import shutil
import signal
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from dnnmso_mj.loading import load_scenario
from dnnmso_mj.reading import log_info, read_trace
from dnnmso_mj.run import run_logged
from dnnmso_mj.sweep.table import read_table
from dnnmso_mj.trace import Trace
from soak.forked import Process, Told, begin, ended, warm_up
from soak.killed import check_ticks, wait_for
from soak.killed_sweeps import untimed
from soak.tally import Form, Tally

DURATION = ["--set", "duration=0.5"]
RUN = ["run", "paper", *DURATION, "--no-plot"]
SLOW = ["run", "paper", *DURATION, "--no-plot", "--real-time"]
SWEEP = ["sweep", "paper", *DURATION, "--seeds", "0:8", "--jobs", "1"]
MARGINS = ["margins", "paper", *DURATION, "--controllers", "pd", "--seeds", "0:1", "--jobs", "1"]
TUNE = ["tune", "paper", *DURATION, "--controller", "pd", "--trials", "3", "--seeds", "0:1"]
SEEDS = 4


@dataclass(frozen=True)
class Runs:
    """What runs of each seed give, and the log of one of them."""

    traces: Sequence[Trace]
    log: Path


def run(form: Form, tally: Tally, folder: Path) -> None:
    """Races for a name, and whoever comes while it is taken."""
    warm_up()
    done = [
        run_logged(load_scenario("paper", ["duration=0.5", f"seed={k}"]), folder / f"{k}.mcap")
        for k in range(SEEDS)
    ]
    runs = Runs([each.trace for each in done], done[0].log)
    rng = np.random.default_rng([form.seed, 13])
    for k in range(form.pick(4, 40)):
        races(tally, runs, folder / f"race-{k}", rng, f"{k}, seed {form.seed}")
    for k in range(form.pick(1, 5)):
        unnamed(tally, runs, folder / f"unnamed-{k}")
        resumes(tally, runs, folder / f"resumes-{k}")
    late(tally, runs, folder / "late")
    links(tally, runs, folder / "links")
    tables(form, tally, folder / "tables")
    figures(tally, folder / "figures")


def races(tally: Tally, runs: Runs, place: Path, rng: np.random.Generator, what: str) -> None:
    """Runs of several seeds begin together; with or without --force, and an old log."""
    force, old = bool(rng.random() < 0.6), bool(rng.random() < 0.5)
    place.mkdir()
    out = place / "run.mcap"
    if old:
        shutil.copyfile(runs.log, out)
    processes = []
    for seed in range(1, SEEDS):
        words = [*SLOW, "--seed", seed, "--out", out, *(["--force"] if force else [])]
        processes.append(begin(words, place))
        time.sleep(rng.choice([0.0, 0.0, 0.01, 0.1]))
    told = [ended(process, place) for process in processes]
    with tally.case(f"race {what}, force {force}, old log {old}"):
        won = [seed for seed, each in enumerate(told, start=1) if each.status == 0]
        for each in told:
            assert each.status == 0 or refused(each, out), each.err[-300:]
        expected = 0 if old and not force else 1
        together = len(won) == expected or (force and len(won) > 1 and one_by_one(told))
        assert together, f"{len(won)} runs had the name"
        whole(out, won[-1:] or [0], runs)
        assert not [path for path in place.iterdir() if path != out], "something is left behind"
    shutil.rmtree(place)


def one_by_one(told: Sequence[Told]) -> bool:
    """Whether runs may have followed each other, the later ones in place of the earlier ones."""
    return all(each.status in {0, 2} for each in told)


def refused(told: Told, out: Path) -> bool:
    """Whether it says that the name is taken, and what to do."""
    ways = ("another name", "another --out", "another --storage", "--resume")
    return told.is_one_error and out.name in told.err and any(way in told.err for way in ways)


def whole(log: Path, seeds: Sequence[int], runs: Runs) -> None:
    """The log is complete, and of one of these seeds alone.

    Raises:
        AssertionError: it is not.
    """
    info = log_info(log)
    assert info.complete, "the log is not whole"
    trace = read_trace(log)
    reference = runs.traces[info.seed]
    assert len(trace) == len(reference), f"{len(trace)} ticks"
    check_ticks(trace, reference)
    assert info.seed in seeds, f"the log is of seed {info.seed}, and {seeds} had the name"


def unnamed(tally: Tally, runs: Runs, place: Path) -> None:
    """Without --out each run finds a name of its own."""
    place.mkdir()
    processes = [begin([*RUN, "--seed", k], place) for k in range(SEEDS)]
    told = [ended(process, place) for process in processes]
    with tally.case("runs without a name"):
        assert all(each.status == 0 for each in told), [each.err for each in told]
        names = sorted(path.name for path in (place / "logs").iterdir())
        expected = ["paper.mcap", *(f"paper-{k}.mcap" for k in range(2, SEEDS + 1))]
        assert names == sorted(expected), f"{names}"
        seeds = Counter(log_info(path).seed for path in (place / "logs").iterdir())
        assert sorted(seeds) == list(range(SEEDS)), f"{seeds}"
        for path in (place / "logs").iterdir():
            whole(path, range(SEEDS), runs)
    shutil.rmtree(place)


def resumes(tally: Tally, runs: Runs, place: Path) -> None:
    """Resumes of one log find names of their own, and one name is taken once."""
    place.mkdir()
    log = place / "run.mcap"
    shutil.copyfile(runs.log, log)
    words = ["resume", log, "--at", "0.2", "--no-plot"]
    told = [ended(p, place) for p in [begin(words, place) for _ in range(3)]]
    with tally.case("resumes without a name"):
        assert all(each.status == 0 for each in told), [each.err for each in told]
        for name in ("run-from-0.2", "run-from-0.2-2", "run-from-0.2-3"):
            whole(place / f"{name}.mcap", [0], runs)
    out = place / "one.mcap"
    told = [ended(p, place) for p in [begin([*words, "--out", out], place) for _ in range(3)]]
    with tally.case("resumes to one name"):
        assert sorted(each.status or 0 for each in told) == [0, 2, 2], [e.err for e in told]
        whole(out, [0], runs)
    out = place / "recovered.mcap"
    words = ["recover", log, "--out", out]
    told = [ended(p, place) for p in [begin(words, place) for _ in range(3)]]
    with tally.case("recoveries to one name"):
        assert sorted(each.status or 0 for each in told) == [0, 2, 2], [e.err for e in told]
        whole(out, [0], runs)
    shutil.rmtree(place)


def late(tally: Tally, runs: Runs, place: Path) -> None:
    """Whoever comes while a run is writing reads its prefix, and may not write."""
    place.mkdir()
    out = place / "run.mcap"
    writer = begin(["run", "paper", "--set", "duration=60", "--no-plot", "--real-time",
                    "--seed", 1, "--out", out], place)  # fmt: skip
    assert wait_for(out.exists), "no log"
    nearer = place / "link"
    nearer.symlink_to(place)
    comers: dict[str, list[Any]] = {
        "run": [*RUN, "--out", out],
        "run --force": [*RUN, "--out", out, "--force"],
        "run --force by another path": [*RUN, "--out", nearer / "run.mcap", "--force"],
        "resume --force": ["resume", runs.log, "--at", "0.1", "--no-plot", "--out", out, "--force"],
        "recover": ["recover", runs.log, "--out", out],
        "sweep": [*SWEEP, "--out", out],
        "sweep --force": [*SWEEP, "--out", out, "--force"],
        "tune": [*TUNE, "--out", out],
    }
    processes = {what: begin(words, place) for what, words in comers.items()}
    lengths = []
    for _ in range(5):
        lengths.append(log_info(out).ticks)
        time.sleep(0.1)
    with tally.case("readers while a run is writing"):
        assert lengths == sorted(lengths), f"{lengths}"
    for what, process in processes.items():
        told = ended(process, place)
        with tally.case(f"{what} while a run is writing"):
            assert refused(told, out), f"status {told.status}: {told.err[-300:]}"
    os.kill(writer.pid or 0, signal.SIGINT)
    told = ended(writer, place)
    with tally.case("the run that was there first"):
        assert told.status == 130, f"it ended before the others: {told.status} {told.err}"
        assert log_info(out).complete, "not whole"
        assert log_info(out).seed == 1, "another's"


def links(tally: Tally, runs: Runs, place: Path) -> None:
    """Links planted at the name, or where a run might write first, are not followed."""
    place.mkdir()
    canary = place / "canary"
    for target in ("a log", "a text", "nothing"):
        for force in ([], ["--force"]):
            out = place / "run.mcap"
            canary.unlink(missing_ok=True)
            if target == "a log":
                shutil.copyfile(runs.log, canary)
            elif target == "a text":
                canary.write_text("precious")
            before = canary.read_bytes() if canary.exists() else None
            out.symlink_to(canary)
            told = ended(begin([*RUN, "--out", out, *force], place), place)
            with tally.case(f"a link to {target} at the name, {force}"):
                assert refused(told, out), f"status {told.status}: {told.err}"
                after = canary.read_bytes() if canary.exists() else None
                assert after == before, "what the link points to has changed"
                assert out.is_symlink(), "the link has gone"
            out.unlink()


def tables(form: Form, tally: Tally, place: Path) -> None:
    """Sweeps, comparisons and margins of one file; and a run of a sweep's name."""
    place.mkdir()
    kinds = {"sweep": SWEEP, "margins": MARGINS} if form.long else {"sweep": SWEEP}
    for kind, words in kinds.items():
        out = place / f"{kind}.parquet"
        told = _together(words, out, place, form.pick(2, 4))
        with tally.case(f"{kind}: several on one file"):
            statuses = sorted(each.status or 0 for each in told)
            assert statuses == [0, *[2] * (len(told) - 1)], [each.err for each in told]
            assert all(each.status == 0 or refused(each, out) for each in told), "impolite"
            read_table(out, _kind(kind))
    out = place / "taken.mcap"
    sweep = begin([*SWEEP, "--out", out], place)
    wait_for(lambda: out.with_name(f"{out.name}.journal").exists())
    log = ended(begin([*RUN, "--out", out], place), place)
    told = ended(sweep, place)
    with tally.case("a run takes the name that a sweep is to write"):
        assert log.status == 0, log.err
        assert refused(told, out), f"status {told.status}: {told.err}"
        assert log_info(out).complete, "the log is gone"
        assert out.with_name(f"{out.name}.journal").exists(), "the rows are gone"
    out.rename(place / "away.mcap")
    told = ended(begin([*SWEEP, "--out", out, "--resume"], place), place)
    with tally.case("the sweep goes on when the log is out of its way"):
        assert told.status == 0, told.err
        ours, other = untimed(read_table(out)[0]), untimed(read_table(place / "sweep.parquet")[0])
        assert ours.equals(other), "another table"


def _together(words: list[str], out: Path, place: Path, count: int) -> list[Told]:
    processes: list[Process] = [begin([*words, "--out", out], place) for _ in range(count)]
    return [ended(process, place, 120.0) for process in processes]


def _kind(name: str) -> Any:
    from dnnmso_mj.margins.run import MARGINS as OF_MARGINS
    from dnnmso_mj.sweep.table import SWEEP as OF_SWEEPS

    return OF_MARGINS if name == "margins" else OF_SWEEPS


def figures(tally: Tally, place: Path) -> None:
    """Two that draw the same figures leave whole ones."""
    place.mkdir()
    words = ["run", "paper", *DURATION]
    told = [ended(p, place, 120.0) for p in [begin(words, place) for _ in range(2)]]
    logs = place / "logs"
    again = ["plot", logs / "paper.mcap"]
    told += [ended(p, place, 120.0) for p in [begin(again, place) for _ in range(2)]]
    with tally.case("figures of two at once"):
        assert all(each.status == 0 for each in told), [each.err for each in told]
        for stem in ("paper", "paper-2"):
            pictures = list(logs.glob(f"{stem}_*.png"))
            assert pictures, f"no figure of {stem}"
            for picture in pictures:
                with Image.open(picture) as image:
                    image.load()
        assert not [name for name in os.listdir(logs) if name.startswith(".")], "left behind"
