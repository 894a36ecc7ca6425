"""One pass over a log: what it holds, checked to be a log of this package."""

# mypy: untyped-calls-exclude=mcap
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from mcap.records import Attachment, Channel, Metadata, Schema
from pydantic import ValidationError

from dnnmso_mj.errors import LogError
from dnnmso_mj.log.format import EVENTS, STEP, event_of, run_info
from dnnmso_mj.log.messages import Messages
from dnnmso_mj.log.prefix import Prefix, Record
from dnnmso_mj.log.step_message import StepFormat, check_schema, layout_of
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.trace import Event, RunInfo

Array = np.ndarray


class Steps:
    """The rows of a log, made of its messages as they come."""

    def __init__(self) -> None:
        self._format: StepFormat | None = None
        self._data = bytearray()  # grows in place: a long log is in memory once
        self._count = 0

    def add(self, messages: Messages) -> None:
        """Take the next messages.

        Raises:
            ValueError: one is no `dnnmso.Step`, or unlike the first.
        """
        if self._format is None:
            self._format = StepFormat(layout_of(messages.data[0].tobytes()))
        self._data += self._format.decode(messages.data, self._count).tobytes()
        self._count += len(messages)

    def columns(self) -> dict[str, Array] | None:
        """The columns so far; None without a message."""
        if self._format is None:
            return None
        layout = self._format.layout
        return layout.columns(np.frombuffer(self._data).reshape(-1, layout.width))


@dataclass
class Scan:
    """What one pass over a log collects."""

    path: Path
    size: int
    add_steps: Callable[[Messages], None] | None
    complete: bool = False
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)  # topic -> messages
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, int] = field(default_factory=dict)
    events: list[Event] = field(default_factory=list)
    ticks: int = 0

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
        channel = self.channels.get(messages.channel_id)
        if channel is None:  # the format forbids it
            return
        self.counts[channel.topic] += len(messages)
        if channel.topic == STEP.name:
            if not self.ticks:
                self._check_schema(channel)
            self.ticks += len(messages)
        try:
            if channel.topic == STEP.name and self.add_steps is not None:
                self.add_steps(messages)
            elif channel.topic == EVENTS.name:
                self.events += [event_of(message.tobytes()) for message in messages.data]
        except ValueError as error:
            raise self.error(f"{channel.topic}: {error}. Run the scenario again") from error

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
        try:
            return Scenario.model_validate_json(self.metadata["scenario"]["json"])
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

    def _writer(self) -> str:
        """The program that wrote the log, as far as it says."""
        return f"dnnmso_mj {self.metadata.get('versions', {}).get('dnnmso_mj', 'of its time')}"


def scan(path: Path, steps: Callable[[Messages], None] | None = None) -> Scan:
    """Read a log once, complete or torn; `steps` takes the messages on /step.

    Raises:
        LogError: the file is no log of this package.
    """
    prefix = Prefix(path)
    log = Scan(path, prefix.size, steps)
    for record in prefix:
        log.add(record)
    log.complete = prefix.complete
    log.check()
    return log
