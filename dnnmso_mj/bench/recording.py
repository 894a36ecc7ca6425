"""What logging costs the loop's own thread, against the MCAP library as it comes."""

# mypy: untyped-calls-exclude=mcap
from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import make_reader

from dnnmso_mj.bench.tick import paper
from dnnmso_mj.bench.timing import Check, Contender, Probe, Table, race
from dnnmso_mj.log.format import NS_PER_S
from dnnmso_mj.log.step_message import SCHEMA_NAME, schema
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.recording import McapRecorder
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.scene import Scene
from dnnmso_mj.simulation import Simulation, simulate
from dnnmso_mj.trace import FLAGS, SCALARS, RunInfo, StepLayout

Array = np.ndarray

BLOCK = 20  # ticks, as the loop of a paced run gives them
PERIOD_NS = 200_000  # between two ticks: five times real time, the loop's thread asleep between


class Log(Protocol):
    """A log under way."""

    def append(self, rows: Array) -> None:
        """Take rows (m, width)."""

    def close(self) -> None:
        """Finish the file."""


class OurLog:
    """The package's recorder with all that it puts into a log."""

    def __init__(self, path: Path, run: _Run) -> None:
        scene = Scene(run.simulation.plant.model)
        self._recorder = McapRecorder(
            path, run.layout, run.scenario, scene, run.mjcf.text, real_time=True
        )
        self.append = self._recorder.append

    def close(self) -> None:
        self._recorder.finish(RunInfo(status="ok", seed=0))


class LibraryLog:
    """mcap and mcap-protobuf-support with their defaults: zstd, chunks of 1 MiB."""

    def __init__(self, path: Path, run: _Run) -> None:
        from mcap_protobuf.writer import Writer

        pool = DescriptorPool()
        for file in schema().file:
            pool.Add(file)
        self._message = GetMessageClass(pool.FindMessageTypeByName(SCHEMA_NAME))
        self._slices = run.layout.slices
        self._dt = run.scenario.dt
        self._count = 0
        self._file = path.open("wb")
        self._writer: Any = Writer(self._file)

    def append(self, rows: Array) -> None:
        for row in rows.tolist():
            message = self._message(**{
                name: row[where.start] if name in SCALARS
                else bool(row[where.start]) if name in FLAGS
                else row[where]
                for name, where in self._slices.items()
            })  # fmt: skip
            time_ns = round(self._count * self._dt * NS_PER_S)
            self._writer.write_message("/step", message, time_ns, time_ns, self._count)
            self._count += 1

    def close(self) -> None:
        self._writer.finish()
        self._file.close()


class _Run:
    """A run whose rows are logged again and again."""

    def __init__(self, ticks: int) -> None:
        self.scenario: Scenario = paper(ticks)
        self.mjcf = Mjcf.read(find_model(self.scenario.plant.model))
        self.simulation = Simulation(self.scenario, self.mjcf)
        self.layout: StepLayout = self.simulation.layout
        trace = simulate(self.scenario, self.mjcf)
        columns = [trace[name].reshape(ticks, -1) for name in self.layout.widths]
        self.rows: Array = np.hstack(columns).astype(float)


OpenLog = Callable[[Path, _Run], Log]


def bench_recording(quick: bool) -> list[Table]:
    """One row a tick into a log, as a paced loop does it."""
    ticks, rounds = (300, 2) if quick else (5000, 3)
    run = _Run(ticks)
    contenders = [
        Contender("dnnmso_mj, row by row", "a copy and a lock, and the writer's turn at the GIL",
                  lambda: _probe(OurLog, run, 1)),
        Contender(f"dnnmso_mj, by {BLOCK} rows, a row", "a copy",
                  lambda: _probe(OurLog, run, BLOCK)),
        Contender("mcap, mcap-protobuf: defaults",
                  "protobuf in the interpreter; zstd of a whole 1 MiB chunk at the worst",
                  partial(_library, run)),
    ]  # fmt: skip
    return [
        Table(
            name="recording",
            title="Recording, in the loop's thread",
            work=f"{run.layout.width} doubles a tick, a tick every {PERIOD_NS / 1000:g} µs",
            unit="µs",
            rows=race(contenders, rounds, warm=False),
            checks=_check(run),
        )
    ]


def _library(run: _Run) -> Probe:
    import mcap_protobuf.writer  # noqa: F401  # now, so that a missing package is told of

    return _probe(LibraryLog, run, 1)


def _probe(open_log: OpenLog, run: _Run, block: int) -> Probe:
    def probe() -> Array:
        clock, samples = time.perf_counter_ns, []
        with tempfile.TemporaryDirectory() as folder:
            log = open_log(Path(folder) / "bench.mcap", run)
            due = clock()
            for first in range(0, len(run.rows), block):
                due += PERIOD_NS * block
                time.sleep(max(0.0, (due - clock()) * 1e-9))
                began = clock()
                log.append(run.rows[first : first + block])
                samples.append((clock() - began) * 1e-3 / block)
            log.close()
        return np.array(samples)

    return probe


def _check(run: _Run) -> tuple[Check, ...]:
    """Both logs give back the rows that went in, as the MCAP library itself reads them."""
    try:
        from mcap_protobuf.decoder import DecoderFactory
    except ImportError:
        return ()
    checks, rows = [], run.rows[:BLOCK]
    logs: dict[str, OpenLog] = {"dnnmso_mj": OurLog, "mcap's defaults": LibraryLog}
    for name, open_log in logs.items():
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "check.mcap"
            log = open_log(path, run)
            log.append(rows)
            log.close()
            with path.open("rb") as file:
                reader = make_reader(file, decoder_factories=[DecoderFactory()])
                steps = [found[3] for found in reader.iter_decoded_messages(topics=["/step"])]
        read = [[getattr(step, field) for field in run.layout.widths] for step in steps]
        error = float(np.abs(np.array([np.hstack(step) for step in read]) - rows).max())
        checks.append(Check(f"{name}: rows read back", error, 0.0))
    return tuple(checks)
