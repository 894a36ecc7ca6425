"""Logs back into NumPy columns: complete ones, and the readable prefix of torn ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.records import Attachment

from dnnmso_mj.errors import LogError
from dnnmso_mj.log.format import snapshot_place, unwritable
from dnnmso_mj.log.npz import read_npz
from dnnmso_mj.log.place import Place
from dnnmso_mj.log.prefix import Prefix, copy
from dnnmso_mj.log.scan import scan, scan_trace
from dnnmso_mj.log.segments import RESUMED
from dnnmso_mj.log.writer import LogWriter
from dnnmso_mj.paths import find_log
from dnnmso_mj.trace import Event, Trace

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
    resumed: Mapping[str, str]  # the log that it went on from, at which time, with which changes


@dataclass(frozen=True)
class Snapshot:
    """Arrays that a run kept on the way, e.g. the weights of its controller."""

    name: str
    t: float  # s
    arrays: Mapping[str, Array]


def read_trace(path: str | Path) -> Trace:
    """The columns of a log. A torn log gives its readable prefix and the status "unfinished".

    Args:
        path: a log, or the name of one in the folder `logs`; see `dnnmso_mj.paths.find_log`.

    Raises:
        LogError: the file is no log of this package, or holds not one tick.
    """
    return scan_trace(find_log(path))[1]


def log_info(path: str | Path) -> LogInfo:
    """What a log holds, complete or torn.

    Raises:
        LogError: the file is no log of this package.
    """
    log = scan(find_log(path))
    scenario, run = log.scenario(), log.run()
    return LogInfo(
        path=log.path,
        size=log.size,
        complete=log.complete,
        status=run.status,
        reason=run.reason,
        seed=run.seed,
        scenario=scenario.name,
        ticks=log.ticks,
        duration=log.ticks * scenario.dt,
        wall_s=run.wall_s,
        metrics=run.metrics,
        versions=run.versions,
        git_commit=run.git_commit,
        channels=log.counts,
        attachments=log.attachments,
        events=tuple(log.events),
        resumed=log.metadata.get(RESUMED, {}),
    )


def read_snapshots(path: str | Path) -> list[Snapshot]:
    """The snapshots of a log, in the order they were taken.

    Raises:
        LogError: the file is no MCAP, or a snapshot in it is damaged.
    """
    snapshots = []
    for record in Prefix(find_log(path)):
        if not isinstance(record, Attachment) or not (place := snapshot_place(record.name)):
            continue
        try:
            snapshots.append(Snapshot(*place, read_npz(record.data)))
        except ValueError as error:
            raise LogError(f"{path}: the attachment {record.name} is {error}") from error
    return snapshots


def recover(path: str | Path, out: str | Path) -> LogInfo:
    """Write a complete, indexed log of what is readable in a torn one; returns what it holds.

    Raises:
        LogError: `path` is no log, or `out` exists or cannot be written; nothing is left behind.
    """
    torn, target = log_info(path), Path(out)
    try:
        place = Place(target)
        try:
            writer = LogWriter(place.file)
            # Without its record "run" a log is unfinished, as what was torn must stay.
            prefix = Prefix(torn.path)
            copy(prefix, writer, leave_out=None if torn.complete else "run")
            if prefix.complete != torn.complete:
                raise LogError(f"{torn.path} was changed while it was read. Recover it again")
            writer.finish()
            place.take()
        finally:
            place.give_up()
    except OSError as error:
        raise unwritable(target, error) from error
    return log_info(target)
