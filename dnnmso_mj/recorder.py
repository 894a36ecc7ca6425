"""Where a run goes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from dnnmso_mj.trace import Event

Array = np.ndarray


class Recorder(Protocol):
    """Where the rows of a run go.

    One with an attribute `block`, which may change, takes that many at once; one whose
    `keeps_snapshots` is False is given none.
    """

    def append(self, rows: Array) -> None:
        """Take some ticks: rows (m, `StepLayout.width`), which are overwritten afterwards."""

    def event(self, event: Event) -> None:
        """Take an event."""

    def snapshot(self, name: str, t: float, arrays: Mapping[str, Array]) -> None:
        """Take the whole state of the controller, or of the world, at time t (s)."""
