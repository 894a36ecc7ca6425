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


RATE = 2  # of the flag `saturated`: what acts is the limit of the torque's rate


class Changes:
    """Follows the flags of a run's rows.

    Args:
        layout: of the rows.
        torque_limit: of the drives (N·m); without it, what limits a torque is its rate.

    Attributes:
        flags: the last of each (2,), 0 where it is not set, else 1 or RATE.
    """

    def __init__(self, layout: StepLayout, torque_limit: tuple[float, ...] | None) -> None:
        self._most = expand(torque_limit or (np.inf,), layout.n_joints)
        self._torques = [layout.slices[name] for name in ("tau_cmd", "tau")]
        self._columns = [layout.slices[name].start for name in WORDS]
        self.flags: Array = np.zeros(len(WORDS), np.int64)

    def events(self, rows: Array) -> Iterator[Event]:
        """What the next rows (m, width) change."""
        for k, (column, words) in enumerate(zip(self._columns, WORDS.values(), strict=True)):
            flag = rows[:, column] != 0.0
            before = np.concatenate([self.flags[k : k + 1] != 0, flag[:-1]])
            for i in np.flatnonzero(flag != before):
                yield self._event(k, rows[i], words, begins=bool(flag[i]))

    def _event(self, k: int, row: Array, words: tuple[str, str], *, begins: bool) -> Event:
        kind = self.flags[k]
        if begins:
            kind = RATE if k == 0 and self._is_of_rate(row) else 1
        self.flags[k] = kind if begins else 0
        what = words[0] if begins else words[1]
        if kind == RATE:
            what = what.replace("torque limit", "torque rate limit")
        return Event(float(row[0]), "warning" if begins else "info", what)

    def _is_of_rate(self, row: Array) -> bool:
        """Whether a torque is limited that neither asks for more than there is, nor has it all."""
        asked, given = (np.abs(row[where]) for where in self._torques)
        return bool((asked <= self._most).all() and (given < self._most).all())
