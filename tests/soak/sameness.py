"""When two runs are the same: all that is not of the wall clock, bit for bit."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

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
    """SHA-256 of a log's messages and attachments, but for the wall clock's bytes on /step.

    Each topic by itself: how many ticks come between two others' messages is of the wall clock too.
    """
    found: dict[str, Any] = defaultdict(hashlib.sha256)
    topics, masked = dict[int, str](), None
    for record in Prefix(log):
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Attachment):
            found[record.name].update(str(record.log_time).encode() + record.data)
        elif isinstance(record, Messages):
            topic, data = topics[record.channel_id], record.data
            if topic == "/step":
                masked = _clocked_bytes(data[0].tobytes()) if masked is None else masked
                data = np.where(masked, 0, data)
            parts = {"times": record.time_ns, "numbers": record.sequence, "data": data}
            for name, part in parts.items():
                found[f"{topic} {name}"].update(np.ascontiguousarray(part).tobytes())
    whole = sorted((name, part.hexdigest()) for name, part in found.items())
    return hashlib.sha256(repr(whole).encode()).hexdigest()


def _clocked_bytes(message: bytes) -> np.ndarray:
    """Which bytes of a message on /step are of the wall clock, (size,)."""
    layout = layout_of(message)
    rows = np.zeros((2, layout.width))
    for name in CLOCKED:
        rows[1, layout.slices[name]] = np.frombuffer(b"\xff" * 8)
    zero, ones = StepFormat(layout).encode(rows)
    return np.asarray(zero != ones)
