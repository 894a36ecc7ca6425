"""The log of a run as MCAP: cheap enough to write from a 1 kHz loop, whole up to its last blocks.

Rows are collected in a small block and written together, each block a chunk of its own, so that a
killed process loses at most one block. Scenario, seed, versions, commit and model go first, so
that a torn log still says what it is.
"""

# mypy: untyped-calls-exclude=mcap
from __future__ import annotations

import signal
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from dnnmso_mj.errors import LogError
from dnnmso_mj.log.format import (
    EVENTS,
    MODEL,
    NS_PER_S,
    STEP,
    Topic,
    create,
    event_message,
    metrics_record,
    new_writer,
    run_record,
    scenario_record,
    snapshot_data,
    snapshot_name,
    unwritable,
)
from dnnmso_mj.log.scene_messages import (
    ROBOT_DESCRIPTION,
    SCENE,
    TF,
    frame_transforms,
    robot_description,
    scene_update,
)
from dnnmso_mj.log.step_message import StepFormat
from dnnmso_mj.provenance import git_commit, software_versions
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.scene import Scene
from dnnmso_mj.trace import Event, RunInfo, StepLayout

Array = np.ndarray

_BLOCK_S = 0.05  # simulated time held in memory at most
_TF_PERIOD_S = 0.01


class McapRecorder:
    """Writes one run to an MCAP file; a context manager.

    Left without `finish`, the log ends with the status "interrupted" (Ctrl-C) or "failed" and the
    exception as reason.

    Args:
        path: the log, which must not exist; its folder is made.
        layout: what a row holds.
        scenario: the resolved scenario.
        scene: the robot as a picture.
        mjcf: the model's MJCF text, kept as the attachment "model.xml".
        force: whether an existing file is removed first.

    Raises:
        LogError: the file exists or cannot be written; nothing is left behind.
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
    ) -> None:
        self.path = Path(path)
        self._layout = layout
        self._format = StepFormat(layout)
        self._scenario = scenario
        self._scene = scene
        self._block = np.empty((max(1, int(_BLOCK_S / scenario.dt + 1e-9)), layout.width))
        self._filled = 0
        self._events: list[Event] = []
        self._written = 0  # ticks
        self._closed = False
        self._channels: dict[str, int] = {}
        self._tf_stride = max(1, int(np.ceil(_TF_PERIOD_S / scenario.dt - 1e-9)))
        first = ((ROBOT_DESCRIPTION, robot_description(scene.urdf())), (SCENE, scene_update(scene)))
        self._file = create(self.path, force)
        try:
            with self._writing():
                self._start(mjcf, first)
        except BaseException:
            self._file.close()
            self.path.unlink(missing_ok=True)
            raise

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

    def append(self, row: Array) -> None:
        """Add one tick: a row (width,), copied; a full block is written to the file.

        Raises:
            LogError: the file cannot be written.
        """
        self._block[self._filled] = row
        self._filled += 1
        if self._filled == len(self._block):
            with self._writing():
                self._write_block()

    def event(self, event: Event) -> None:
        """Add a line to the log's events; it goes to the file with the ticks that led to it."""
        self._events.append(event)

    def snapshot(self, name: str, t: float, arrays: Mapping[str, Array]) -> None:
        """Attach arrays, e.g. a controller's weights, as they are at time t (s).

        Raises:
            LogError: an array holds Python objects, or the file cannot be written.
        """
        data = snapshot_data(name, arrays)
        with self._writing():
            self._attach(snapshot_name(name, t), t, "application/zip", data)
            self._writer.flush()

    @property
    def ticks(self) -> int:
        """Number of ticks taken so far."""
        return self._written + self._filled

    def flush(self) -> None:
        """Hand everything so far to the operating system, so that the file can be read.

        Raises:
            LogError: the file cannot be written.
        """
        with self._writing():
            self._write_block()

    def finish(self, info: RunInfo) -> None:
        """Write what is left, the status and the metrics, and close the file.

        Versions and commit stand in the log from its start; those of `info` are not written again.

        Raises:
            LogError: a metric is not finite, or the file cannot be written.
        """
        metrics = metrics_record(info.metrics)
        with self._writing(), self._file:
            self._write_block()
            self._writer.add_metadata("metrics", metrics)
            self._writer.add_metadata("run", run_record(info))
            self._writer.finish()
            self._closed = True

    def _start(self, mjcf: str, first: Iterable[tuple[Topic, bytes]]) -> None:
        versions, commit = software_versions(), git_commit()
        self._writer = new_writer(self._file)
        self._writer.add_metadata("scenario", scenario_record(self._scenario))
        self._writer.add_metadata("versions", versions)
        if commit:
            self._writer.add_metadata("git", {"commit": commit})
        self._attach(MODEL, 0.0, "application/xml", mjcf.encode())
        for topic in (STEP, TF, ROBOT_DESCRIPTION, SCENE, EVENTS):
            schema_id = self._writer.register_schema(
                topic.schema_name, topic.schema_encoding, topic.schema
            )
            self._channels[topic.name] = self._writer.register_channel(
                topic.name, topic.encoding, schema_id
            )
        for topic, message in first:
            self._add(topic, 0, message)
        self._writer.flush()

    def _write_block(self) -> None:
        """Write rows and events so far as a chunk, and hand it to the operating system."""
        rows = self._block[: self._filled]
        ticks = range(self._written, self._written + self._filled)
        self._written, self._filled = ticks.stop, 0
        times_ns = [round(k * self._scenario.dt * NS_PER_S) for k in ticks]
        for k, time_ns, message in zip(ticks, times_ns, self._format.encode(rows), strict=True):
            self._add(STEP, time_ns, message, k)
        self._write_frames(ticks, times_ns, rows)
        events, self._events = self._events, []
        for event in events:
            self._add(EVENTS, round(event.t * NS_PER_S), event_message(event))
        self._writer.flush()

    def _write_frames(self, ticks: range, times_ns: list[int], rows: Array) -> None:
        """Where the links are, at no more than 100 Hz."""
        q, q_ref = (rows[:, self._layout.slices[name]] for name in ("q", "q_ref"))
        # A diverged arm is nowhere to be drawn; /step still says what its angles are.
        drawn = np.isfinite(q).all(axis=1) & np.isfinite(q_ref).all(axis=1)
        drawn &= np.array(ticks, dtype=int) % self._tf_stride == 0
        times_ns = [times_ns[j] for j in np.flatnonzero(drawn)]
        messages = frame_transforms(self._scene, times_ns, q[drawn], q_ref[drawn])
        for time_ns, message in zip(times_ns, messages, strict=True):
            self._add(TF, time_ns, message)

    def _add(self, topic: Topic, time_ns: int, message: bytes, sequence: int = 0) -> None:
        channel = self._channels[topic.name]
        self._writer.add_message(channel, time_ns, message, time_ns, sequence)

    def _attach(self, name: str, t: float, media_type: str, data: bytes) -> None:
        time_ns = round(t * NS_PER_S)
        self._writer.add_attachment(time_ns, time_ns, name, media_type, data)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Name the file in errors; write nothing after one, so that the prefix stays readable."""
        try:
            with _interrupt_deferred():
                yield
        except OSError as error:
            self._closed = True
            with suppress(OSError):
                self._file.close()
            raise unwritable(self.path, error) from error


@contextmanager
def _interrupt_deferred() -> Iterator[None]:
    """Let Ctrl-C wait for the end of a write, since half a chunk would spoil the file behind it."""
    if threading.current_thread() is not threading.main_thread():
        yield  # Python delivers signals to the main thread alone
        return
    caught: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: caught.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if caught:
            signal.raise_signal(signal.SIGINT)
