"""Where something stands in a recording: at a simulated time, and at a tick."""

from __future__ import annotations

import numpy as np
import rerun as rr

from dnnmso_mj.trace import Array
from dnnmso_mj.viewer.plot import TIMELINE

TICKS = "tick"


def stamps(t: Array, ticks: Array) -> list[rr.TimeColumn]:
    """Times (s) and ticks, both (N,), as Rerun's time columns."""
    ns = np.rint(1e9 * t).astype("timedelta64[ns]")  # Rerun would cut, not round
    return [rr.TimeColumn(TIMELINE, duration=ns), rr.TimeColumn(TICKS, sequence=ticks)]
