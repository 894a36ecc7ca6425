"""The log of a run as MCAP: cheap enough to write from a 1 kHz loop, whole up to its last blocks.

The loop's thread only copies rows; a thread of its own lays them out, compresses them and writes
them, each block a chunk of its own. A killed process loses what no block had been made of yet: at
most 0.1 s of a run that keeps to the wall clock, whose disk keeps pace; and of any other run what
was simulated within the last 0.1 s. Scenario, seed, versions, commit and model go first, so that a
torn log still says what it is.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Self

import numpy as np

from dnnmso_mj.errors import LogError
from dnnmso_mj.log.background import Background
from dnnmso_mj.log.content import LogContent
from dnnmso_mj.log.format import check_snapshot, metrics_record, run_record, unwritable
from dnnmso_mj.log.place import Place
from dnnmso_mj.log.writer import LogWriter
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.scene import Scene
from dnnmso_mj.trace import Event, RunInfo, StepLayout

Array = np.ndarray

BACKLOG_BYTES = 64 * 2**20  # that may wait for a slow disk while there are deadlines to keep
# What the loop may simulate before it gives rows: a block is in the making while another is
# written and `content` may hold back some more, all together no more than a kill may cost.
BLOCK_S, PACED_BLOCK_S = 0.04, 0.02
MOST_TICKS, FEW_TICKS = 50, 10


class McapRecorder:
    """Writes one run to an MCAP file; a context manager.

    Left without `finish`, the log ends with the status "interrupted" (Ctrl-C) or "failed" and the
    exception as reason. `append`, `event` and `snapshot` cost the caller microseconds while the
    block before is written; beyond that the caller waits, so that a kill costs little. A caller
    with deadlines waits only where `BACKLOG_BYTES` do for the disk, and the log says so then.

    Args:
        path: the log, which must not exist; its folder is made. No other run can write it, nor
            replace it, until this one has ended.
        layout: what a row holds.
        scenario: the resolved scenario.
        scene: the robot as a picture.
        mjcf: the model's MJCF text, kept as the attachment "model.xml".
        force: whether an existing log is replaced, once this one has begun.
        real_time: whether the caller has deadlines to keep.
        records: metadata that this log has besides, by name.
        files: attachments that it has besides, by name.

    Raises:
        LogError: the file exists or cannot be written; nothing is left behind. A write that fails
            later is raised by the next call of any method.
    """

    def __init__(
        self,
        path: str | Path,
        layout: StepLayout,
        scenario: Scenario,
        scene: Scene,
        mjcf: str,
        *,
        force: bool = False,
        real_time: bool = False,
        records: Mapping[str, dict[str, str]] = MappingProxyType({}),
        files: Mapping[str, bytes] = MappingProxyType({}),
    ) -> None:
        self.path = Path(path)
        self._scenario = scenario
        self._ticks = 0
        self._closed = False
        self.broken = False  # whether the log could not be written to its end
        self._real_time = real_time
        try:
            self._place = Place(self.path, force)
            self._file = self._place.file
            try:
                self._content = LogContent(LogWriter(self._file), layout, scenario, scene)
                self._content.start(mjcf, records, files)
                self._place.take()
            except BaseException:
                self._place.give_up()
                raise
        except OSError as error:
            raise unwritable(self.path, error) from error
        self._most = ticks_in_a_block(scenario.dt, real_time)
        self._block = min(self._most, FEW_TICKS)
        self._given_at = time.perf_counter()
        row = 8 * layout.width
        self._background = Background(BACKLOG_BYTES if real_time else self._most * row)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._closed:
            return
        status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
        reason = f"{type(error).__name__}: {error}" if error else "left without finish()"
        try:
            self.finish(RunInfo(status=status, seed=self._scenario.seed, reason=reason))
        except LogError:
            if error is None:
                raise  # otherwise the error under way is the one to tell

    def append(self, rows: Array) -> None:
        """Add a block of ticks: rows (m, width), copied.

        Raises:
            LogError: the file could not be written.
        """
        block = np.array(rows, ndmin=2)
        with self._writing():
            per_tick = (time.perf_counter() - self._given_at) / max(1, len(block))
            self._block = max(1, min(self._most, int(BLOCK_S / max(per_tick, 1e-9))))
            self._background.put(partial(self._content.take, block), block.nbytes)
            self._given_at = time.perf_counter()
        self._ticks += len(block)

    def event(self, event: Event) -> None:
        """Add a line to the log's events; it goes to the file with the ticks that led to it.

        Raises:
            LogError: the file could not be written.
        """
        with self._writing():
            self._background.put_off(partial(self._content.events.append, event))

    def snapshot(self, name: str, t: float, arrays: Mapping[str, Array]) -> None:
        """Attach arrays, copied, e.g. a controller's weights, as they are at time t (s).

        Raises:
            LogError: an array holds Python objects, or the file could not be written.
        """
        copies = {key: np.array(value) for key, value in arrays.items()}
        check_snapshot(name, copies)
        size = sum(array.nbytes for array in copies.values())
        with self._writing():
            self._background.put_off(partial(self._content.attach_snapshot, name, t, copies), size)

    @property
    def ticks(self) -> int:
        """Number of ticks taken so far."""
        return self._ticks

    @property
    def block(self) -> int:
        """How many ticks the loop is to do before it gives their rows, as fast as it is now."""
        return self._block

    @property
    def readable(self) -> Path:
        """Where what has been written can be read, even if its name has been taken away."""
        if self._file.closed or self._place.is_there:
            return self.path
        return Path(f"/proc/self/fd/{self._file.fileno()}")

    @property
    def waited_s(self) -> float:
        """For how long the loop had to wait for the disk so far."""
        return self._background.waited_s

    def flush(self) -> int:
        """Wait until everything so far is with the operating system, so that it can be read.

        Returns:
            How many ticks that is; a Ctrl-C in `append` may have kept the last block out.

        Raises:
            LogError: the file cannot be written.
        """
        with self._writing():
            self._background.put(self._content.flush)
            self._background.drain()
        return self._content.ticks

    def finish(self, info: RunInfo) -> None:
        """Write what is left, the status and the metrics, and close the file.

        Versions and commit stand in the log from its start; those of `info` are not written again.

        Raises:
            LogError: a metric is not finite, or the file cannot be written.
        """
        records = {"metrics": metrics_record(info.metrics), "run": run_record(info)}
        if self._real_time and self.waited_s:
            t = self._ticks * self._scenario.dt
            waited = f"the run waited {self.waited_s:.3g} s for the disk that its log is on"
            self.event(Event(t, "warning", waited))
        with self._writing():
            self._background.put(partial(self._content.finish, records))
            self._background.drain()
            if not self._place.is_there:
                raise FileNotFoundError("it was moved or removed while the run was writing")
            self._file.close()
            self._closed = True
            self._background.stop()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Name the file in errors; write nothing after one, so that the prefix stays readable."""
        try:
            yield
        except OSError as error:
            self._closed = self.broken = True
            self._background.stop()
            with suppress(OSError):
                self._file.close()
            raise unwritable(self.path, error) from error


def ticks_in_a_block(dt: float, real_time: bool) -> int:
    """As many as a kill may cost, twice and a bit; without deadlines not too few to go fast."""
    ticks = int((PACED_BLOCK_S if real_time else BLOCK_S) / dt + 1e-9)
    return min(MOST_TICKS, max(1 if real_time else FEW_TICKS, ticks))
