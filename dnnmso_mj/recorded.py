"""A log read whole: for what goes on from it, and for what is compared with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.records import Attachment

from dnnmso_mj.errors import LogError
from dnnmso_mj.log.format import MODEL, snapshot_place
from dnnmso_mj.log.npz import read_npz
from dnnmso_mj.log.scan import scan_trace
from dnnmso_mj.log.segments import Segment, read_segments
from dnnmso_mj.trace import StepLayout, Trace
from dnnmso_mj.wording import clean

Array = np.ndarray


@dataclass(frozen=True)
class Recorded:
    """All that a log holds.

    Args:
        path: of it.
        trace: its columns, scenario, status and events.
        layout: of its rows.
        snapshots: npz files by tick and name.
        files: its other attachments, by name.
        segments: which scenario was in force when; one, unless the run was resumed.
    """

    path: Path
    trace: Trace
    layout: StepLayout
    snapshots: Mapping[tuple[int, str], bytes]
    files: Mapping[str, bytes]
    segments: tuple[Segment, ...]

    def arrays(self, tick: int, name: str) -> dict[str, Array]:
        """A snapshot.

        Raises:
            LogError: it is damaged.
        """
        try:
            return read_npz(self.snapshots[tick, name])
        except ValueError as error:
            t = tick * self.trace.scenario.dt
            raise LogError(f"{self.path}: the snapshot {name} of {t:g} s is {error}") from error

    def model(self, name: str = MODEL) -> str:
        """The MJCF in an attachment.

        Raises:
            LogError: there is none, or it is no text.
        """
        try:
            return self.files[name].decode()
        except KeyError:
            raise LogError(f"{self.path}: has no attachment {clean(name)}. Run it again") from None
        except UnicodeDecodeError as error:
            raise LogError(f"{self.path}: its attachment {clean(name)} is no UTF-8") from error

    def segment(self, tick: int) -> Segment:
        """The one that a tick belongs to."""
        return [part for part in self.segments if part.first <= tick][-1]


def read_recorded(path: Path) -> Recorded:
    """Read a log, complete or torn.

    Raises:
        LogError: the file is no log of this package, or holds not one tick.
    """
    snapshots: dict[tuple[str, float], bytes] = {}
    files: dict[str, bytes] = {}

    def keep(record: Attachment) -> None:
        place = snapshot_place(record.name)
        if place is None:
            files[record.name] = record.data
        else:
            snapshots[place] = record.data

    log, trace = scan_trace(path, keep)
    try:
        segments = read_segments(log.metadata, trace.scenario)
    except ValueError as error:
        raise log.error(f"{error}. Read it with the version that wrote it") from error
    layout = StepLayout(trace.n_joints, trace.n_layers)
    dt = trace.scenario.dt
    by_tick = {(round(t / dt), name): data for (name, t), data in snapshots.items()}
    return Recorded(path, trace, layout, by_tick, files, tuple(segments))
