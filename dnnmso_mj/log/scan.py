"""One pass over a log: what it holds, checked to be a log of this package."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from mcap.records import Attachment, Channel, Metadata, Schema
from pydantic import ValidationError

from dnnmso_mj.errors import LogError
from dnnmso_mj.log import limits
from dnnmso_mj.log.format import EVENTS, STEP, event_of, run_info
from dnnmso_mj.log.json_texts import check_json
from dnnmso_mj.log.messages import Messages
from dnnmso_mj.log.prefix import Prefix, Record
from dnnmso_mj.log.step_message import StepFormat, check_schema, layout_of
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.trace import Event, RunInfo, Trace

Array = np.ndarray

BLOCK = 4096  # messages that are decoded at once


class Steps:
    """The rows of a log, made of its messages as they come.

    Args:
        size: of the file (bytes), which bounds how many there may be.
    """

    def __init__(self, size: int) -> None:
        self._most, self._most_odd = limits.rows(size), limits.odd_steps(size)
        self._format: StepFormat | None = None
        self._data = bytearray()  # grows in place: a long log is in memory once
        self._count = 0

    def add(self, messages: Messages) -> None:
        """Take the next messages.

        Raises:
            ValueError: one is no `dnnmso.Step`, or unlike the first; or there are too many.
        """
        if messages.data.shape[1] > limits.STEP:
            raise ValueError(f"a message of {messages.data.shape[1]} bytes; {limits.STEP} at most")
        if self._format is None:
            self._format = StepFormat(layout_of(messages.data[0].tobytes()))
        for first in range(0, len(messages), BLOCK):
            self._add(self._format, messages.data[first : first + BLOCK])

    def columns(self) -> dict[str, Array] | None:
        """The columns so far; None without a message."""
        if self._format is None:
            return None
        layout = self._format.layout
        return layout.columns(np.frombuffer(self._data).reshape(-1, layout.width))

    def _add(self, form: StepFormat, data: Array) -> None:
        count = self._count + len(data)
        if 8 * form.layout.width * count > self._most:
            raise ValueError(f"more than {self._most} bytes of numbers, too much for its size")
        self._data += form.decode(data, self._count).tobytes()
        self._count = count
        if form.odd > self._most_odd:
            raise ValueError(f"more than {self._most_odd} messages of another program's layout")


@dataclass
class Scan:
    """What one pass over a log collects."""

    path: Path
    size: int
    steps: Steps | None = None
    complete: bool = False
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)  # topic -> messages
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, int] = field(default_factory=dict)
    events: list[Event] = field(default_factory=list)
    ticks: int = 0
    _event_bytes: int = 0
    _numbered: bool = True  # whether the messages on /step are

    def error(self, problem: str) -> LogError:
        return LogError(f"{self.path}: {problem}.")

    def add(self, record: Record) -> None:
        match record:
            case Messages():
                self._add_messages(record)
            case Schema():
                self.schemas.setdefault(record.id, record)
            case Channel():
                self.channels.setdefault(record.id, record)
                self.counts.setdefault(record.topic, 0)
            case Metadata():
                self.metadata[record.name] = record.metadata
            case Attachment():
                self.attachments[record.name] = len(record.data)

    def _add_messages(self, messages: Messages) -> None:
        channel = self.channels[messages.channel_id]
        self.counts[channel.topic] += len(messages)
        if channel.topic == STEP.name:
            if not self.ticks:
                self._check_schema(channel)
            self.ticks += len(messages)
            self._numbered = int(messages.sequence[-1]) == self.ticks - 1
        try:
            if channel.topic == STEP.name and self.steps is not None:
                self.steps.add(messages)
            elif channel.topic == EVENTS.name:
                self._add_events(messages.data)
        except ValueError as error:
            raise self.error(f"{channel.topic}: {error}. Run the scenario again") from error

    def _add_events(self, data: Array) -> None:
        self._event_bytes += len(data) * (limits.EVENT + data.shape[1])
        most = limits.events(self.size)
        if self._event_bytes > most:
            raise limits.too_much(self.path, "bytes of events", most, self.size)
        self.events += [event_of(message.tobytes()) for message in data]

    def check(self) -> None:
        """Refuse a log that is not ours.

        Raises:
            LogError: it has no scenario, or no channel /step of ours.
        """
        if "json" not in self.metadata.get("scenario", {}):
            raise self.error(
                "no metadata record 'scenario': an MCAP of another program, or a run killed "
                "before its log began. Logs are what `dnnmso run` writes"
            )
        step = next((c for c in self.channels.values() if c.topic == STEP.name), None)
        if step is None:
            topics = ", ".join(sorted(c.topic for c in self.channels.values())) or "none"
            raise self.error(
                f"no channel {STEP.name}; its channels: {topics}. Run the scenario again"
            )
        self._check_schema(step)

    def _check_schema(self, step: Channel) -> None:
        schema = self.schemas.get(step.schema_id)
        if schema is None or (schema.name, schema.encoding) != (STEP.schema_name, "protobuf"):
            found = f"{schema.name} ({schema.encoding})" if schema else "no schema"
            raise self.error(
                f"channel {STEP.name} has {found}; expected {STEP.schema_name} (protobuf). "
                "Give a log that `dnnmso run` wrote"
            )
        try:
            check_schema(schema.data)
        except ValueError as error:
            raise self.error(f"{error}. Read it with {self._writer()}") from error

    def scenario(self) -> Scenario:
        text = self.metadata["scenario"]["json"]
        try:
            check_json(text)
        except ValueError as error:
            raise self.error(f"its scenario is {error}. Run the scenario again") from error
        try:
            return Scenario.model_validate_json(text)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"])) or "the text"
            raise self.error(
                f"its scenario is not one of this version: {where}: {first['msg']}. "
                f"Read it with {self._writer()}"
            ) from error

    def run(self) -> RunInfo:
        try:
            info = run_info(self.metadata)
        except ValueError as error:
            raise self.error(f"a metadata record is damaged: {error}. Run it again") from error
        return info if self.complete else replace(info, status="unfinished")

    def trace(self) -> Trace:
        """All ticks, once `steps` has taken them.

        Raises:
            LogError: there is none, or they are not those of the scenario.
        """
        columns = self.steps.columns() if self.steps else None
        if columns is None:
            raise self.error("holds no tick: the run ended before its first. Run it again")
        scenario, t = self.scenario(), columns["t"]
        joints = columns["q"].shape[1]
        if joints != scenario.n_joints:
            raise self.error(
                f"{joints} joints on {STEP.name}; its scenario has {scenario.n_joints}. "
                "Run the scenario again"
            )
        self._check_times(t, scenario.dt)
        return Trace(columns, scenario, self.run(), tuple(self.events))

    def _check_times(self, t: Array, dt: float) -> None:
        """Numbers of messages say that none is missing; without them the ticks' times must."""
        far = np.inf if self._numbered else dt / 4
        wrong = ~(np.abs(t - dt * np.arange(len(t))) < far)
        if wrong.any():
            k = int(wrong.argmax())
            raise self.error(
                f"tick {k} is of t = {t[k]:g} s; expected {k * dt:g} s: ticks are missing, or not "
                "in their order. Run the scenario again"
            )

    def _writer(self) -> str:
        """The program that wrote the log, as far as it says."""
        return f"dnnmso_mj {self.metadata.get('versions', {}).get('dnnmso_mj', 'of its time')}"


def scan(
    path: Path, *, steps: bool = False, files: Callable[[Attachment], None] | None = None
) -> Scan:
    """Read a log once, complete or torn.

    Args:
        path: the file.
        steps: whether its ticks are kept, for `Scan.trace`.
        files: takes the attachments.

    Raises:
        LogError: the file is no log of this package.
    """
    prefix = Prefix(path)
    log = Scan(path, prefix.size, Steps(prefix.size) if steps else None)
    for record in prefix:
        log.add(record)
        if files is not None and isinstance(record, Attachment):
            files(record)
    log.complete = prefix.complete
    log.check()
    return log
