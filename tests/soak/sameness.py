"""When two runs are the same: all that is not of the wall clock, bit for bit."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from mcap.records import Attachment, Channel

from dnnmso_mj.difference import CLOCKED
from dnnmso_mj.log.messages import Messages
from dnnmso_mj.log.prefix import Prefix
from dnnmso_mj.log.step_message import StepFormat, layout_of
from dnnmso_mj.sweep.table import TIMING
from dnnmso_mj.trace import Trace

# What only a network that is watched has.
MONITORS = ("weight_norm", "update_ratio", "eta_bound", "gradient_change", "drt_bound")


def columns_digest(trace: Trace, without: tuple[str, ...] = ()) -> str:
    """SHA-256 of all columns but those of the wall clock."""
    found = hashlib.sha256()
    for name, column in trace.columns.items():
        if name not in (*CLOCKED, *without):
            found.update(f"{name} {column.dtype} {column.shape}".encode())
            found.update(np.ascontiguousarray(column).tobytes())
    return found.hexdigest()


def digest(trace: Trace) -> str:
    """SHA-256 of a run: its columns, how it ended, its events and its metrics."""
    events = [(event.t, event.level, event.message) for event in trace.events]
    ended = (trace.info.status, trace.info.reason, trace.info.seed)
    rest = repr((ended, events, untimed(trace.metrics)))
    return hashlib.sha256((columns_digest(trace) + rest).encode()).hexdigest()


def untimed(row: Mapping[str, object]) -> dict[str, object]:
    """Of a row, or of metrics, what is not of the wall clock; all digits count."""
    return {name: value for name, value in row.items() if name not in TIMING}


def log_digest(log: Path) -> str:
    """SHA-256 of a log's messages and attachments, but for the wall clock's bytes on /step."""
    found, topics, masked = hashlib.sha256(), dict[int, str](), None
    for record in Prefix(log):
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Attachment):
            found.update(f"{record.name} {record.log_time}".encode() + record.data)
        elif isinstance(record, Messages):
            data = record.data
            if topics[record.channel_id] == "/step":
                if masked is None:
                    masked = _clocked_bytes(data[0].tobytes())
                data = np.where(masked, 0, data)
            found.update(topics[record.channel_id].encode())
            for part in (record.time_ns, record.sequence, data):
                found.update(np.ascontiguousarray(part).tobytes())
    return found.hexdigest()


def _clocked_bytes(message: bytes) -> np.ndarray:
    """Which bytes of a message on /step are of the wall clock, (size,)."""
    layout = layout_of(message)
    rows = np.zeros((2, layout.width))
    for name in CLOCKED:
        rows[1, layout.slices[name]] = np.frombuffer(b"\xff" * 8)
    zero, ones = StepFormat(layout).encode(rows)
    return np.asarray(zero != ones)
