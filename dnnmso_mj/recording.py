"""The log of a run as MCAP: cheap enough to write from a 1 kHz loop, whole up to its last blocks.

The loop's thread only copies rows; a thread of its own lays them out, compresses them and writes
them, each block a chunk of its own, so that a killed process loses one block and what the disk had
not taken yet. Scenario, seed, versions, commit and model go first, so that a torn log still says
what it is.
"""

from __future__ import annotations

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
from dnnmso_mj.log.format import check_snapshot, create, metrics_record, run_record, unwritable
from dnnmso_mj.log.writer import LogWriter
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.scene import Scene
from dnnmso_mj.trace import Event, RunInfo, StepLayout

Array = np.ndarray

BACKLOG_BYTES = 64 * 2**20  # rows that may wait for a disk that is slower than the loop


class McapRecorder:
    """Writes one run to an MCAP file; a context manager.

    Left without `finish`, the log ends with the status "interrupted" (Ctrl-C) or "failed" and the
    exception as reason. `append`, `event` and `snapshot` cost the caller microseconds, whatever the
    disk does, until `BACKLOG_BYTES` wait for it; then the caller waits, and the log says so.

    Args:
        path: the log, which must not exist; its folder is made.
        layout: what a row holds.
        scenario: the resolved scenario.
        scene: the robot as a picture.
        mjcf: the model's MJCF text, kept as the attachment "model.xml".
        force: whether an existing log is removed first.
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
        records: Mapping[str, dict[str, str]] = MappingProxyType({}),
        files: Mapping[str, bytes] = MappingProxyType({}),
    ) -> None:
        self.path = Path(path)
        self._scenario = scenario
        self._ticks = 0
        self._closed = False
        self._file = create(self.path, force)
        try:
            self._content = LogContent(LogWriter(self._file), layout, scenario, scene)
            self._content.start(mjcf, records, files)
        except BaseException as error:
            with suppress(OSError):
                self._file.close()
            self.path.unlink(missing_ok=True)
            if isinstance(error, OSError):
                raise unwritable(self.path, error) from error
            raise
        self._background = Background(BACKLOG_BYTES)

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
            self._background.put(partial(self._content.take, block), block.nbytes)
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
    def waited_s(self) -> float:
        """For how long the loop had to wait for the disk so far."""
        return self._background.waited_s

    def flush(self) -> None:
        """Wait until everything so far is with the operating system, so that it can be read.

        Raises:
            LogError: the file cannot be written.
        """
        with self._writing():
            self._background.put(self._content.flush)
            self._background.drain()

    def finish(self, info: RunInfo) -> None:
        """Write what is left, the status and the metrics, and close the file.

        Versions and commit stand in the log from its start; those of `info` are not written again.

        Raises:
            LogError: a metric is not finite, or the file cannot be written.
        """
        records = {"metrics": metrics_record(info.metrics), "run": run_record(info)}
        if self.waited_s:
            t = self._ticks * self._scenario.dt
            waited = f"the run waited {self.waited_s:.3g} s for the disk that its log is on"
            self.event(Event(t, "warning", waited))
        with self._writing():
            self._background.put(partial(self._content.finish, records))
            self._background.put(self._file.close)
            self._background.drain()
            self._closed = True
            self._background.stop()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Name the file in errors; write nothing after one, so that the prefix stays readable."""
        try:
            yield
        except OSError as error:
            self._closed = True
            self._background.stop()
            with suppress(OSError):
                self._file.close()
            raise unwritable(self.path, error) from error
