"""A run for two: all that one recorder takes, another takes after it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dnnmso_mj.recorder import Recorder
from dnnmso_mj.recording import McapRecorder
from dnnmso_mj.trace import Event

Array = np.ndarray


class Tee:
    """Hands on all of a run to its log, then to its viewer."""

    def __init__(self, log: McapRecorder, live: Recorder) -> None:
        self._log, self._live = log, live

    @property
    def block(self) -> int:
        """What the log takes at once."""
        return self._log.block

    def append(self, rows: Array) -> None:
        self._log.append(rows)
        self._live.append(rows)

    def event(self, event: Event) -> None:
        self._log.event(event)
        self._live.event(event)

    def snapshot(self, name: str, t: float, arrays: Mapping[str, Array]) -> None:
        self._log.snapshot(name, t, arrays)
        self._live.snapshot(name, t, arrays)
