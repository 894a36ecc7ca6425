"""A run kept in memory: the recorder of whoever wants no log."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dnnmso_mj.scenario import Scenario
from dnnmso_mj.trace import Event, RunInfo, StepLayout, Trace

Array = np.ndarray

LARGEST_BLOCK = 250  # ticks at once, where nothing waits for the rows


class MemoryRecorder:
    """Keeps a run in memory and makes a `Trace` of it.

    Args:
        layout: of the rows.
        n_ticks: how many rows there can be.
    """

    block = LARGEST_BLOCK
    keeps_snapshots = False

    def __init__(self, layout: StepLayout, n_ticks: int) -> None:
        self._layout = layout
        self._rows = np.empty((n_ticks, layout.width))
        self._count = 0
        self._events: list[Event] = []

    def append(self, rows: Array) -> None:
        self._rows[self._count : self._count + len(rows)] = rows
        self._count += len(rows)

    def event(self, event: Event) -> None:
        self._events.append(event)

    def snapshot(self, name: str, t: float, arrays: Mapping[str, Array]) -> None:
        """Snapshots are for logs; memory keeps none."""

    def trace(self, scenario: Scenario, info: RunInfo) -> Trace:
        """The columns recorded so far."""
        columns = self._layout.columns(self._rows[: self._count])
        return Trace(columns, scenario, info, tuple(self._events))
