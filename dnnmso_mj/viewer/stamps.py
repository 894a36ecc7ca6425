"""Where something stands in a recording: at a simulated time, and at a tick."""

from __future__ import annotations

import rerun as rr

from dnnmso_mj.trace import Array

TIMELINE = "time"  # what every line, pose and event is placed on: simulated time
TICKS = "tick"


def stamps(t: Array, ticks: Array) -> list[rr.TimeColumn]:
    """Times (s) and ticks, both (N,), as Rerun's time columns."""
    return [rr.TimeColumn(TIMELINE, duration=t), rr.TimeColumn(TICKS, sequence=ticks)]
