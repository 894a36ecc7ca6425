"""Torn, flipped and made-up logs: a true prefix or one typed error, in bounded memory and time."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
from log_samples import write_log

from soak import log_damage, log_made, log_tables
from soak.ended import dnnmso
from soak.log_damage import Case
from soak.tally import Form, Tally

READER = "soak.log_worker"
TICKS = 400
MEMORY, FACTOR = 64e6, 10  # bytes, and bytes a byte of the file
SECONDS, TIMES = 2.0, 10  # of a reader, and times what it takes for the good log


class Worker:
    """A process that reads logs, each in a child.

    Args:
        original: the good log.
        broken: how the reader is spoiled, in a negative control; see `soak.log_broken`.
    """

    def __init__(self, original: Path, broken: str | None = None) -> None:
        words = ["soak.log_broken", str(original), broken] if broken else [READER, str(original)]
        path = os.pathsep.join([str(Path(__file__).parents[1]), *filter(None, sys.path)])
        self.process = subprocess.Popen(
            [sys.executable, "-m", *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {"PYTHONPATH": path},
            cwd=original.parent,
            text=True,
        )
        assert self._line() == "ready\n", "the reader of logs did not start"

    def read(self, path: Path, kind: str) -> dict[str, Any]:
        """What became of a log; see `soak.log_worker.attempt`."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps([os.fsencode(path).hex(), kind]) + "\n")
        self.process.stdin.flush()
        found: dict[str, Any] = json.loads(self._line())
        return found

    def close(self) -> None:
        """End it."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()

    def _line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline()


class Readers:
    """Workers, and what the good log costs them.

    Args:
        original: the good log.
        tally: of what became of the others.
        broken: see `Worker`.
        count: of workers.
    """

    def __init__(
        self, original: Path, tally: Tally, broken: str | None = None, count: int = 2
    ) -> None:
        self._tally = tally
        self._free: SimpleQueue[Worker] = SimpleQueue()
        self._all = [Worker(original, broken) for _ in range(count)]
        for worker in self._all:
            self._free.put(worker)
        good = [worker.read(original, "whole") for worker in self._all]
        self.problems = [problem for found in good for problem in found["problems"]]
        self._peak = min(found["peak"] for found in good)
        self._seconds = {
            name: min(found["seconds"][name] for found in good) for name in good[0]["seconds"]
        }
        self.worst = {"memory": 0.0, "seconds": 0.0, "refused": 0, "read": 0}

    def judge(self, name: str, path: Path, kind: str) -> None:
        """Read a log, and count what became of it."""
        size = path.stat().st_size if path.is_file() else 0
        worker = self._free.get()
        try:
            found = worker.read(path, kind)
        finally:
            self._free.put(worker)
        problems = list(found["problems"])
        more = max(0, found["peak"] - self._peak)
        if more > MEMORY + FACTOR * size:
            problems.append(f"{more / 1e6:.0f} MB for a file of {size / 1e6:.3f} MB")
        for reader, seconds in found["seconds"].items():
            if seconds > SECONDS + TIMES * self._seconds[reader]:
                problems.append(f"{reader}: {seconds:.1f} s")
        self.worst["memory"] = max(self.worst["memory"], more / (MEMORY + FACTOR * size))
        self.worst["seconds"] = max([self.worst["seconds"], *found["seconds"].values()])
        self.worst["refused" if found["refused"] == len(found["seconds"]) else "read"] += 1
        if problems:
            self._tally.lose(f"{name}: {'; '.join(problems)}")
        else:
            self._tally.survive()

    def judge_all(self, jobs: Iterable[tuple[str, Callable[[], Path], str]]) -> None:
        """Logs with a name, what makes the file, and their kind; two at a time."""

        def one(job: tuple[str, Callable[[], Path], str]) -> None:
            name, make, kind = job
            path = make()
            try:
                self.judge(name, path, kind)
            finally:
                path.unlink(missing_ok=True)

        with ThreadPoolExecutor(2) as pool:
            list(pool.map(one, jobs))

    def close(self) -> None:
        """End the workers."""
        for worker in self._all:
            worker.close()


def run(form: Form, tally: Tally, folder: Path) -> None:
    """Every reader on every kind of log that is no good one."""
    original = folder / "good.mcap"
    write_log(original, TICKS)
    readers = Readers(original, tally)
    try:
        for problem in readers.problems:
            tally.lose(f"the good log: {problem}")
        damaged(form, readers, original, folder)
        made(form, readers, folder)
        places(readers, tally, original, folder)
        changing(form, readers, original, folder)
    finally:
        readers.close()
    commands(form, tally, original, folder)
    log_tables.tables(form, tally, folder)
    tally.figure("most memory (of what is allowed)", round(readers.worst["memory"], 3))
    tally.figure("slowest reader (s of CPU)", round(readers.worst["seconds"], 2))
    tally.figure("logs read at least in part", readers.worst["read"])
    tally.figure("logs refused", readers.worst["refused"])


def cases(form: Form, data: bytes) -> Iterator[Case]:
    """All damage of a good log."""
    rng = np.random.default_rng(form.seed)
    yield from log_damage.truncations(data, form.pick(60, 1000), rng)
    yield from log_damage.flips(data, form.pick(4, 40), rng)
    yield from log_damage.frames(data, form.pick(30, 250), rng)
    yield from log_damage.blocks(data, form.pick(30, 250), rng)
    yield from log_damage.splices(data, form.pick(10, 60), rng)


def damaged(form: Form, readers: Readers, original: Path, folder: Path) -> None:
    """The good log, cut, flipped, and with bytes put in and taken out."""
    data = original.read_bytes()

    def job(k: int, case: Case) -> tuple[str, Callable[[], Path], str]:
        def make() -> Path:
            path = folder / f"damaged-{k}.mcap"
            path.write_bytes(case.data)
            return path

        return case.name, make, "whole" if case.data == data else "damaged"

    readers.judge_all(job(k, case) for k, case in enumerate(cases(form, data)))


def made(form: Form, readers: Readers, folder: Path) -> None:
    """Logs whose checksums are right."""

    def job(k: int, write: Callable[[Path], None]) -> Callable[[], Path]:
        def make() -> Path:
            path = folder / f"made-{k}.mcap"
            write(path)
            return path

        return make

    every = log_made.makers()
    names = list(every)
    if not form.long:
        names = np.random.default_rng(form.seed).permutation(names)[:30].tolist()
    readers.judge_all((name, job(k, every[name]), "made") for k, name in enumerate(names))


def places(readers: Readers, tally: Tally, original: Path, folder: Path) -> None:
    """What is no regular file, cannot be opened, or has a name that few have."""
    there = folder / "places"
    there.mkdir()
    (there / "folder.mcap").mkdir()
    os.mkfifo(there / "fifo.mcap")
    with socket.socket(socket.AF_UNIX) as held:
        held.bind(os.path.relpath(there / "socket.mcap"))
    (there / "loop.mcap").symlink_to("loop.mcap")
    (there / "dangling.mcap").symlink_to("nothing")
    (there / "empty.mcap").touch()
    (there / "linked-fifo.mcap").symlink_to("fifo.mcap")
    (there / "magic.mcap").write_bytes(original.read_bytes()[:8])
    (there / "text.mcap").write_text("t,q\n0,1\n")
    (there / "zeros.mcap").write_bytes(bytes(100_000))
    devices = ["/dev/zero", "/dev/full", "/dev/null", "/proc/self/mem", "/proc/kmsg"]
    for path in [*sorted(there.iterdir()), *(Path(device) for device in devices)]:
        readers.judge(f"{path.name}", path, "damaged")
    for name in (b"\xff\xfe.mcap", b"a\nb.mcap", b"\x1b[31m.mcap", b"[bold].mcap", b" .mcap"):
        path = Path(os.fsdecode(os.fsencode(there) + b"/" + name))
        path.write_bytes(original.read_bytes())
        readers.judge(f"a good log called {name!r}", path, "whole")
    secret = there / "secret.mcap"
    secret.write_bytes(original.read_bytes())
    secret.chmod(0)
    if not os.access(secret, os.R_OK):
        readers.judge("no permission", secret, "damaged")
    else:  # who may read all files may read this one
        readers.judge("no permission, but to us", secret, "whole")


def changing(form: Form, readers: Readers, original: Path, folder: Path) -> None:
    """A log that grows and is cut while it is read, as often as can be."""
    data, path = original.read_bytes(), folder / "changing.mcap"
    rng = np.random.default_rng(form.seed)
    path.write_bytes(data)
    done = threading.Event()

    def change() -> None:
        with path.open("r+b") as file:
            while not done.is_set():
                at = int(rng.integers(8, len(data)))
                file.truncate(at)
                file.seek(at)
                file.write(data[at:])
                file.flush()

    other = threading.Thread(target=change)
    other.start()
    try:
        for k in range(form.pick(4, 40)):
            readers.judge(f"changed while it is read, {k}", path, "made")
    finally:
        done.set()
        other.join()


def commands(form: Form, tally: Tally, original: Path, folder: Path) -> None:
    """Some by the real command line: a prefix, or status 2 and one message."""
    data, torn = original.read_bytes(), folder / "torn.mcap"
    torn.write_bytes(data[: len(data) * 2 // 3])
    none = folder / "none.mcap"
    none.write_bytes(data[:100])
    fifo = folder / "fifo.mcap"
    os.mkfifo(fifo)
    words = [("info", torn), ("info", none), ("report", fifo, "--out", folder / "a.html")]
    if form.long:
        words += [
            ("recover", torn), ("recover", none), ("diff", torn, original), ("diff", none, torn),
            ("plot", none), ("plot", torn), ("resume", none, "--at", "0.1"),
            ("resume", torn, "--at", "0.1"), ("replay", none, "--save", folder / "a.rrd"),
            ("replay", torn, "--save", folder / "b.rrd"),
            ("report", none, "--out", folder / "b.html"),
            ("report", torn, "--out", folder / "c.html"),
            ("info", fifo), ("recover", fifo),
        ]  # fmt: skip
    for line in words:
        ended = dnnmso(*line, seconds=120.0, cwd=folder)
        one = ended.is_one_error and ended.err.count("error: ") == 1
        if one or (ended.status in (0, 1) and torn in line and "Traceback" not in ended.err):
            tally.survive()
        else:
            tally.lose(f"dnnmso {' '.join(map(str, line))}: {ended.status}: {ended.err[-300:]}")
