"""The events of a run that its rows tell: a torque limit begins to act, a deadline is missed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dnnmso_mj.scenario import expand
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
        torque_limit: of the drives (N·m); without it, what limits a torque is its rate.

    Attributes:
        flags: the last of each (2,), as bool.
    """

    def __init__(self, layout: StepLayout, torque_limit: tuple[float, ...] | None) -> None:
        self._most = expand(torque_limit or (np.inf,), layout.n_joints)
        self._torques = [layout.slices[name] for name in ("tau_cmd", "tau")]
        self._rate = False  # whether what is acting is the limit of the rate
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
                if k == 0:
                    what = self._named(rows[i], what, begins=bool(flag[i]))
                yield Event(float(rows[i, 0]), level, what)

    def _named(self, row: Array, what: str, *, begins: bool) -> str:
        """The same words, of the limit that acts: that of the torque, or of its rate."""
        if begins:
            asked, given = (np.abs(row[where]) for where in self._torques)
            self._rate = bool((asked <= self._most).all() and (given < self._most).all())
        return what.replace("torque limit", "torque rate limit") if self._rate else what
