"""Messages on /step as rows of numbers, checked to be the ticks of a scenario, and all of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from dnnmso_mj.log import limits
from dnnmso_mj.log.messages import Messages
from dnnmso_mj.log.step_message import StepFormat, layout_of
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.trace import StepLayout

Array = np.ndarray
Take = Callable[[StepLayout, Array], None]  # takes a layout and the next rows of it, (N, width)

BLOCK = 4096  # messages that are decoded at once


class Rows:
    """The rows of a log's messages, as they come.

    Args:
        scenario: of the log.
        size: of the file (bytes), which bounds what is read slowly.
    """

    def __init__(self, scenario: Scenario, size: int) -> None:
        self._joints, self._dt = scenario.n_joints, scenario.dt
        self._most_odd = limits.odd_steps(size)
        self._format: StepFormat | None = None
        self._count = 0

    def decode(self, messages: Messages) -> Iterator[tuple[StepLayout, Array]]:
        """The layout, and the rows of the next messages in blocks.

        Raises:
            ValueError: one is no `dnnmso.Step` of the scenario, or unlike the first, or not of its
                time; or too many are laid out by another program.
        """
        if messages.data.shape[1] > limits.STEP:
            raise ValueError(f"a message of {messages.data.shape[1]} bytes; {limits.STEP} at most")
        form = self._format = self._format or self._begin(messages.data[0].tobytes())
        for first in range(0, len(messages), BLOCK):
            part = messages[first : first + BLOCK]
            rows = form.decode(part.data, self._count)
            self._check_times(rows[:, form.layout.slices["t"].start], part.sequence)
            self._count += len(rows)
            if form.odd > self._most_odd:
                raise ValueError(f"more than {self._most_odd} messages of another program's layout")
            yield form.layout, rows

    def _begin(self, message: bytes) -> StepFormat:
        layout = layout_of(message)
        if layout.n_joints != self._joints:
            raise ValueError(f"{layout.n_joints} joints; the log's scenario has {self._joints}")
        return StepFormat(layout)

    def _check_times(self, t: Array, numbers: Array) -> None:
        """Numbers of messages say that none is missing; without them, times must."""
        numbered = int(numbers[-1]) == self._count + len(t) - 1
        expected = self._dt * (self._count + np.arange(len(t)))
        wrong = ~(np.abs(t - expected) < (np.inf if numbered else self._dt / 4))
        if wrong.any():
            k = int(wrong.argmax())
            raise ValueError(
                f"tick {self._count + k} is of t = {t[k]:g} s; expected {expected[k]:g} s: ticks "
                "are missing, or not in their order"
            )


class Kept:
    """All rows of a log, in memory.

    Args:
        size: of the file (bytes), which bounds how many there may be.
    """

    def __init__(self, size: int) -> None:
        self._most = limits.rows(size)
        self._layout: StepLayout | None = None
        self._data = bytearray()  # grows in place: a long log is in memory once

    def add(self, layout: StepLayout, rows: Array) -> None:
        """Take the next rows.

        Raises:
            ValueError: they are too many.
        """
        if len(self._data) + rows.nbytes > self._most:
            raise ValueError(f"more than {self._most} bytes of numbers: too many for its size")
        self._layout = layout
        self._data += rows.tobytes()

    def columns(self) -> dict[str, Array] | None:
        """The columns so far; None without a row."""
        if self._layout is None:
            return None
        return self._layout.columns(np.frombuffer(self._data).reshape(-1, self._layout.width))
