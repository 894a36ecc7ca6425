"""What goes into the log of a run, and in which order."""

from __future__ import annotations

import time
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from dnnmso_mj.log.format import (
    EVENTS,
    MODEL,
    NS_PER_S,
    STEP,
    event_message,
    scenario_record,
    snapshot_data,
    snapshot_name,
)
from dnnmso_mj.log.messages import HEADER_SIZE, Messages
from dnnmso_mj.log.scene_messages import (
    ROBOT_DESCRIPTION,
    SCENE,
    TF,
    FrameMessages,
    robot_description,
    scene_update,
)
from dnnmso_mj.log.step_message import StepFormat
from dnnmso_mj.log.writer import CHUNK_BYTES, LogWriter
from dnnmso_mj.provenance import git_commit, software_versions
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.scene import Scene
from dnnmso_mj.trace import Event, StepLayout

Array = np.ndarray

_WAIT_S = 0.02  # simulated time, and wall time, that waits for a chunk to be full
_MOST_TICKS = 50  # in a chunk
_TF_PERIOD_S = 0.01


class LogContent:
    """Writes rows, events, frames and snapshots of one run; few rows wait for more, a short while.

    Args:
        writer: of a new file.
        layout: what a row holds.
        scenario: the resolved scenario.
        scene: the robot as a picture.

    Every method raises OSError where the file cannot be written.
    """

    def __init__(
        self, writer: LogWriter, layout: StepLayout, scenario: Scenario, scene: Scene
    ) -> None:
        self.events: list[Event] = []
        self._writer = writer
        self._q, self._q_ref = layout.slices["q"], layout.slices["q_ref"]
        self._scenario = scenario
        self._scene = scene
        self._format = StepFormat(layout)
        self._frames = FrameMessages(scene)
        fitting = max(1, CHUNK_BYTES // (HEADER_SIZE + self._format.size))
        self._block = np.empty((min(_MOST_TICKS, fitting), layout.width))
        self._enough = min(len(self._block), max(1, int(_WAIT_S / scenario.dt + 1e-9)))
        self._filled = 0
        self._flushed = time.monotonic()
        self._written = 0  # ticks
        self._tf_stride = max(1, int(np.ceil(_TF_PERIOD_S / scenario.dt - 1e-9)))
        self._channels: dict[str, int] = {}

    def start(
        self,
        mjcf: str,
        records: Mapping[str, dict[str, str]] = MappingProxyType({}),
        files: Mapping[str, bytes] = MappingProxyType({}),
    ) -> None:
        """What every log begins with, and metadata records and files that this one has besides."""
        writer, commit = self._writer, git_commit()
        writer.add_metadata("scenario", scenario_record(self._scenario))
        writer.add_metadata("versions", software_versions())
        if commit:
            writer.add_metadata("git", {"commit": commit})
        for name, record in records.items():
            writer.add_metadata(name, record)
        writer.add_attachment(0, MODEL, "application/xml", mjcf.encode())
        for name, data in files.items():
            writer.add_attachment(0, name, "application/octet-stream", data)
        for topic in (STEP, TF, ROBOT_DESCRIPTION, SCENE, EVENTS):
            schema_id = writer.add_schema(topic.schema_name, topic.schema_encoding, topic.schema)
            self._channels[topic.name] = writer.add_channel(topic.name, topic.encoding, schema_id)
        robot = robot_description(self._scene.urdf())
        writer.add_message(self._channels[ROBOT_DESCRIPTION.name], 0, robot)
        writer.add_message(self._channels[SCENE.name], 0, scene_update(self._scene))
        writer.flush()

    @property
    def ticks(self) -> int:
        """How many are written."""
        return self._written

    def take(self, rows: Array) -> None:
        """Add rows to the block in progress, and write it once it holds enough."""
        while len(rows):
            part = rows[: len(self._block) - self._filled]
            self._block[self._filled : self._filled + len(part)] = part
            self._filled += len(part)
            rows = rows[len(part) :]
            late = time.monotonic() - self._flushed > _WAIT_S
            if self._filled == len(self._block) or (
                not len(rows) and (self._filled >= self._enough or late)
            ):
                self.flush()

    def attach_snapshot(self, name: str, t: float, arrays: Mapping[str, Array]) -> None:
        """Write a snapshot."""
        data = snapshot_data(arrays)
        time_ns = round(t * NS_PER_S)
        self._writer.add_attachment(time_ns, snapshot_name(name, t), "application/zip", data)
        self._writer.flush()

    def flush(self) -> None:
        """Write rows and events so far as a chunk, and hand it to the operating system."""
        rows = self._block[: self._filled]
        ticks = self._written + np.arange(len(rows))
        self._written, self._filled = self._written + len(rows), 0
        times_ns = np.rint(ticks * self._scenario.dt * NS_PER_S).astype(np.uint64)
        if len(rows):
            steps = self._format.encode(rows)
            channel = self._channels[STEP.name]
            self._writer.add_messages(Messages(channel, times_ns, ticks, steps))
            self._write_frames(ticks, times_ns, rows)
        for event in self.events:
            time_ns = round(event.t * NS_PER_S)
            self._writer.add_message(self._channels[EVENTS.name], time_ns, event_message(event))
        self.events.clear()
        self._writer.flush()
        self._flushed = time.monotonic()

    def finish(self, records: Mapping[str, dict[str, str]]) -> None:
        """Write what is left, metadata records and the end of the file."""
        self.flush()
        for name, record in records.items():
            self._writer.add_metadata(name, record)
        self._writer.finish()

    def _write_frames(self, ticks: Array, times_ns: Array, rows: Array) -> None:
        """Where the links are, at no more than 100 Hz."""
        drawn = ticks % self._tf_stride == 0
        q, q_ref = rows[drawn, self._q], rows[drawn, self._q_ref]
        # A diverged arm is nowhere to be drawn; /step still says what its angles are.
        finite = np.isfinite(q).all(axis=1) & np.isfinite(q_ref).all(axis=1)
        times = times_ns[drawn][finite].tolist()
        frames = self._frames.encode(times, q[finite], q_ref[finite])
        for time_ns, message in zip(times, frames, strict=True):
            self._writer.add_message(self._channels[TF.name], time_ns, message)
