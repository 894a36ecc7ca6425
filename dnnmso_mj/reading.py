"""Logs back into NumPy columns: complete ones, and the readable prefix of torn ones."""

# mypy: untyped-calls-exclude=mcap
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from pydantic import ValidationError

from dnnmso_mj.errors import LogError
from dnnmso_mj.log.format import (
    EVENTS,
    STEP,
    create,
    event_of,
    new_writer,
    run_info,
    snapshot_arrays,
    snapshot_place,
    unwritable,
)
from dnnmso_mj.log.prefix import Prefix, copy
from dnnmso_mj.log.step_message import StepFormat, check_schema, layout_of
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.trace import Event, RunInfo, Trace

Array = np.ndarray


@dataclass(frozen=True)
class LogInfo:
    """What a log holds, without its numbers."""

    path: Path
    size: int  # bytes
    complete: bool  # False: torn by a kill or a full disk; its prefix is readable
    status: str  # "unfinished" when torn; else as RunInfo has it
    reason: str
    seed: int
    scenario: str  # its name
    ticks: int
    duration: float  # s, simulated time that the ticks cover
    wall_s: float
    metrics: Mapping[str, float | int | bool | None]
    versions: Mapping[str, str]
    git_commit: str
    channels: Mapping[str, int]  # topic -> number of messages
    attachments: Mapping[str, int]  # name -> bytes
    events: tuple[Event, ...]


@dataclass(frozen=True)
class Snapshot:
    """Arrays that a run kept on the way, e.g. the weights of its controller."""

    name: str
    t: float  # s
    arrays: Mapping[str, Array]


def read_trace(path: str | Path) -> Trace:
    """The columns of a log. A torn log gives its readable prefix and the status "unfinished".

    Raises:
        LogError: the file is no log of this package, or holds not one tick.
    """
    log = _scan(Path(path))
    if not log.steps:
        raise log.error("holds no tick: the run ended before its first. Run it again")
    try:
        layout = layout_of(log.steps[0])
        columns = layout.columns(StepFormat(layout).decode(log.steps))
    except ValueError as error:
        raise log.error(f"{STEP.name}: {error}. Run the scenario again") from error
    return Trace(columns, log.scenario(), log.run(), tuple(log.events))


def log_info(path: str | Path) -> LogInfo:
    """What a log holds, complete or torn.

    Raises:
        LogError: the file is no log of this package.
    """
    log = _scan(Path(path))
    scenario, run = log.scenario(), log.run()
    return LogInfo(
        path=log.path,
        size=log.size,
        complete=log.complete,
        status=run.status,
        reason=run.reason,
        seed=run.seed,
        scenario=scenario.name,
        ticks=len(log.steps),
        duration=len(log.steps) * scenario.dt,
        wall_s=run.wall_s,
        metrics=run.metrics,
        versions=run.versions,
        git_commit=run.git_commit,
        channels=log.counts,
        attachments=log.attachments,
        events=tuple(log.events),
    )


def read_snapshots(path: str | Path) -> list[Snapshot]:
    """The snapshots of a log, in the order they were taken.

    Raises:
        LogError: the file is no MCAP, or a snapshot in it is damaged.
    """
    snapshots = []
    for record in Prefix(Path(path)):
        if not isinstance(record, Attachment) or not (place := snapshot_place(record.name)):
            continue
        try:
            snapshots.append(Snapshot(*place, snapshot_arrays(record.data)))
        except ValueError as error:
            raise LogError(f"{path}: the attachment {record.name} is {error}") from error
    return snapshots


def recover(path: str | Path, out: str | Path) -> LogInfo:
    """Write a complete, indexed log of what is readable in a torn one; returns what it holds.

    Raises:
        LogError: `path` is no log, or `out` exists or cannot be written; nothing is left behind.
    """
    torn, target = log_info(path), Path(out)
    file = create(target)
    try:
        with file:
            writer = new_writer(file)
            # Without its record "run" a log is unfinished, as what was torn must stay.
            copy(Prefix(torn.path), writer, leave_out=None if torn.complete else "run")
            writer.finish()
    except BaseException as error:
        target.unlink()
        if isinstance(error, OSError):
            raise unwritable(target, error) from error
        raise
    return log_info(target)


@dataclass
class _Log:
    """What one pass over a log collects."""

    path: Path
    size: int
    complete: bool = False
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)  # topic -> messages
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, int] = field(default_factory=dict)
    steps: list[bytes] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)

    def error(self, problem: str) -> LogError:
        return LogError(f"{self.path}: {problem}.")

    def add(self, record: McapRecord) -> None:
        match record:
            case Message():
                self._add_message(record)
            case Schema():
                self.schemas[record.id] = record
            case Channel():
                self.channels[record.id] = record
                self.counts.setdefault(record.topic, 0)
            case Metadata():
                self.metadata[record.name] = record.metadata
            case Attachment():
                self.attachments[record.name] = len(record.data)

    def _add_message(self, message: Message) -> None:
        channel = self.channels.get(message.channel_id)
        if channel is None:  # the format forbids it
            return
        self.counts[channel.topic] += 1
        if channel.topic == STEP.name:
            self.steps.append(message.data)
        elif channel.topic == EVENTS.name:
            try:
                self.events.append(event_of(message.data))
            except ValueError as error:
                raise self.error(str(error)) from error

    def check(self) -> None:
        """Refuse a log that is not ours before its numbers are looked at."""
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


def _scan(path: Path) -> _Log:
    prefix = Prefix(path)
    log = _Log(path, prefix.size)
    for record in prefix:
        log.add(record)
    log.complete = prefix.complete
    log.check()
    return log
