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
from dnnmso_mj.log.rows import Kept, Rows, Take
from dnnmso_mj.log.step_message import check_schema
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.trace import Event, RunInfo, Trace

Array = np.ndarray


@dataclass
class Scan:
    """What one pass over a log collects."""

    path: Path
    size: int
    take: Take | None = None
    complete: bool = False
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)  # topic -> messages
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, int] = field(default_factory=dict)
    events: list[Event] = field(default_factory=list)
    ticks: int = 0
    _event_bytes: int = 0
    _rows: Rows | None = None

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
        try:
            if channel.topic == STEP.name and self.take is not None:
                self._rows = self._rows or Rows(self.scenario(), self.size)
                for layout, rows in self._rows.decode(messages):
                    self.take(layout, rows)
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
        self._scenario_text()
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
        text = self._scenario_text()
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

    def trace(self, columns: dict[str, Array] | None) -> Trace:
        """The log as a trace of these columns.

        Raises:
            LogError: there is none.
        """
        if columns is None:
            raise self.error("holds no tick: the run ended before its first. Run it again")
        return Trace(columns, self.scenario(), self.run(), tuple(self.events))

    def _scenario_text(self) -> str:
        text = self.metadata.get("scenario", {}).get("json")
        if text is None:
            raise self.error(
                "no metadata record 'scenario': an MCAP of another program, or a run killed "
                "before its log began. Logs are what `dnnmso run` writes"
            )
        return text

    def _writer(self) -> str:
        """The program that wrote the log, as far as it says."""
        return f"dnnmso_mj {self.metadata.get('versions', {}).get('dnnmso_mj', 'of its time')}"


def scan(
    path: Path, take: Take | None = None, files: Callable[[Attachment], None] | None = None
) -> Scan:
    """Read a log once, complete or torn.

    Args:
        path: the file.
        take: takes the rows of its ticks.
        files: takes the attachments.

    Raises:
        LogError: the file is no log of this package.
    """
    prefix = Prefix(path)
    log = Scan(path, prefix.size, take)
    for record in prefix:
        log.add(record)
        if files is not None and isinstance(record, Attachment):
            files(record)
    log.complete = prefix.complete
    log.check()
    return log


def scan_trace(path: Path, files: Callable[[Attachment], None] | None = None) -> tuple[Scan, Trace]:
    """Read a log once, with all of its ticks.

    Raises:
        LogError: the file is no log of this package, or holds not one tick.
    """
    kept = Kept(Prefix(path).size)
    log = scan(path, kept.add, files)
    return log, log.trace(kept.columns())
