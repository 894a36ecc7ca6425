"""The rows of a log in blocks of ticks, so that a log need not be in memory to be gone through."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from dnnmso_mj.log import limits
from dnnmso_mj.log.prefix import Prefix
from dnnmso_mj.log.scan import Scan, scan
from dnnmso_mj.trace import StepLayout

Array = np.ndarray
Columns = dict[str, Array]


class _Blocks:
    """Collects rows until they fill a block."""

    def __init__(self, take: Callable[[Columns], None], ticks: int, size: int) -> None:
        self._take, self._ticks, self._most = take, ticks, limits.rows(size)
        self._layout: StepLayout | None = None
        self._filled = 0

    def add(self, layout: StepLayout, rows: Array) -> None:
        """Take the next rows.

        Raises:
            ValueError: a block of them is too large for the file.
        """
        if self._layout is None:
            if 8 * self._ticks * layout.width > self._most:
                raise ValueError(f"rows of {layout.width} numbers: too wide for its size")
            self._layout = layout
            self._rows = np.empty((self._ticks, layout.width))
        while len(rows):
            part = rows[: self._ticks - self._filled]
            self._rows[self._filled : self._filled + len(part)] = part
            self._filled += len(part)
            rows = rows[len(part) :]
            if self._filled == self._ticks:
                self.end()

    def end(self) -> None:
        """Give what has come since the last block."""
        if self._layout is not None and self._filled:
            self._take(self._layout.columns(self._rows[: self._filled]))
            self._filled = 0


def scan_blocks(path: Path, take: Callable[[Columns], None], ticks: int) -> Scan:
    """Read a log once, complete or torn, and give the columns of each block to a function.

    Args:
        path: of the log.
        take: is given columns, which are overwritten afterwards.
        ticks: in a block; the last one may have fewer.

    Raises:
        LogError: the file is no log of this package.
    """
    blocks = _Blocks(take, ticks, Prefix(path).size)
    found = scan(path, blocks.add)
    blocks.end()
    return found


def outline(
    path: Path, n_ticks: int, signals: Callable[[Columns], Array], buckets: int
) -> tuple[Scan, Columns]:
    """A log's ticks at which a signal is smallest or largest among its neighbours, and both ends.

    Args:
        path: of the log.
        n_ticks: that it holds.
        signals: (m, k) of the columns of m ticks, which it may change.
        buckets: of neighbours; what is kept is at most 2k + 2 ticks of each.

    Raises:
        LogError: the file is no log of this package.
    """
    kept: list[Columns] = []

    def take(columns: Columns) -> None:
        values = signals(columns)
        extreme = np.concatenate([values.argmin(axis=0), values.argmax(axis=0)])
        ticks = np.unique([0, len(values) - 1, *extreme])
        kept.append({name: column[ticks] for name, column in columns.items()})

    found = scan_blocks(path, take, -(-n_ticks // buckets))
    return found, _joined(kept)


def _joined(parts: Iterable[Columns]) -> Columns:
    whole = list(parts)
    return {name: np.concatenate([part[name] for part in whole]) for name in whole[0]}
