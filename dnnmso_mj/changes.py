"""The events of a run that its rows tell: the torque limit begins to act, a deadline is missed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dnnmso_mj.trace import Event, StepLayout

Array = np.ndarray

WORDS = {
    "saturated": ("torque limit reached", "torque limit left"),
    "deadline_missed": ("deadline missed: the watchdog acts", "in time again"),
}


class Changes:
    """Follows the flags of a run's rows.

    Args:
        layout: of the rows.

    Attributes:
        flags: the last of each (2,), as bool.
    """

    def __init__(self, layout: StepLayout) -> None:
        self._columns = [layout.slices[name].start for name in WORDS]
        self.flags: Array = np.zeros(len(WORDS), bool)

    def events(self, rows: Array) -> Iterator[Event]:
        """What the next rows (m, width) change."""
        for k, (column, (begins, ends)) in enumerate(
            zip(self._columns, WORDS.values(), strict=True)
        ):
            flag = rows[:, column] != 0.0
            if not (flag.any() or self.flags[k]):
                continue
            before = np.concatenate([self.flags[k : k + 1], flag[:-1]])
            self.flags[k] = flag[-1]
            for i in np.flatnonzero(flag != before):
                level, what = ("warning", begins) if flag[i] else ("info", ends)
                yield Event(float(rows[i, 0]), level, what)
