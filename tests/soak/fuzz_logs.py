"""Fuzzed: the bytes of a log."""

from __future__ import annotations

import random
import zlib
from pathlib import Path
from typing import Any

import log_samples

from dnnmso_mj.reading import log_info, read_snapshots, read_trace, recover
from dnnmso_mj.recorded import read_recorded
from dnnmso_mj.trace import StepLayout
from soak.mcap_surgery import operate, put_together, take_apart

MAX_LEN = 60_000
WORDS = [
    "lz4", "zstd", "scenario", "json", "run", "status", "/step", "/events", "snapshot/", "npz",
    "dnnmso.Step", "protobuf", "model.xml", "segments", "resumed", "metrics", "MCAP0",
]  # fmt: skip


def seeds(work: Path) -> list[bytes]:
    """Small logs, whole and torn; with a network, without, and of a run that was resumed."""
    found = []
    for count, layers in ((5, 4), (30, 0), (0, 4)):
        path = work / f"{count}.mcap"
        log_samples.write_log(path, count, StepLayout(2, layers))
        found.append(path.read_bytes())
    whole = found[0]
    short = [record for record in take_apart(whole) if record[0] not in (7, 8, 10, 11, 13, 14)]
    return [*found, put_together(short), whole[: len(whole) // 2], whole[:8], b""]


def strategy() -> Any:
    """Whole logs of odd records in any order."""
    from hypothesis import strategies as st

    record = st.tuples(st.integers(0, 20), st.binary(max_size=80))
    return st.lists(record, max_size=6).map(put_together)


def mutate(data: bytes, rng: random.Random, raw: Any) -> bytes:
    return operate(data, rng, lambda part, most: bytes(raw(part, most)))


def target(work: Path) -> Any:
    log, out = work / "log.mcap", work / "out.mcap"

    def tried(data: bytes) -> None:
        log.write_bytes(data)
        readers = (log_info, read_trace, read_snapshots, _everything, _recovered)
        readers[zlib.crc32(data) % len(readers)](log)

    def _everything(path: Path) -> None:
        found = read_recorded(path)
        for tick, name in found.snapshots:
            found.arrays(tick, name)

    def _recovered(path: Path) -> None:
        out.unlink(missing_ok=True)
        recover(path, out)
        read_trace(out)

    return tried
