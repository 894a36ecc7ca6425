"""Where two logs first differ, and by how much.

Numbers are compared bit for bit. What the wall clock decides, and which versions were at work, is
never the same twice: it is told, and not counted as a difference.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dnnmso_mj.recorded import Recorded, read_recorded
from dnnmso_mj.wording import dotted

Array = np.ndarray

CLOCKED = ("compute_us", "wake_late_us")  # columns of the wall clock


@dataclass(frozen=True)
class Place:
    """One number in both logs."""

    tick: int
    t: float  # s
    entry: int  # of the column at that tick
    values: tuple[float, float]

    @property
    def difference(self) -> float:
        """|a − b|, in the column's unit."""
        return abs(self.values[0] - self.values[1])


@dataclass(frozen=True)
class ColumnDifference:
    """A column that is not the same."""

    name: str
    first: Place
    largest: Place


@dataclass(frozen=True)
class Difference:
    """Everything in which two logs differ.

    Args:
        ticks: how many each has; rows are compared as far as both go.
        columns: those that differ, the one that does first first.
        widths: columns whose vectors are not equally long, which are not compared.
        scenario: key paths that differ, with both values.
        status: what each says of its end, where they differ.
        events: of the first log alone, and of the second.
        snapshots: what differs in the states kept, in words.
        files: attachments that differ: models, and what they name.
        clocked: columns of the wall clock that differ; not counted.
        versions: what each was made with, where they differ; not counted.
    """

    ticks: tuple[int, int]
    columns: tuple[ColumnDifference, ...]
    widths: Mapping[str, tuple[int, int]]
    scenario: Mapping[str, tuple[Any, Any]]
    status: tuple[str, str] | None
    events: tuple[tuple[str, ...], tuple[str, ...]]
    snapshots: tuple[str, ...]
    files: tuple[str, ...]
    clocked: tuple[ColumnDifference, ...]
    versions: Mapping[str, tuple[str, str]]

    @property
    def equal(self) -> bool:
        """Whether both logs are of the same run."""
        return self.ticks[0] == self.ticks[1] and not (
            self.columns
            or self.widths
            or self.scenario
            or self.status
            or any(self.events)
            or self.snapshots
            or self.files
        )

    def plain(self) -> dict[str, Any]:
        """The same for JSON, which has no infinity: such numbers are texts in it."""
        columns, clocked = (
            [
                {
                    "name": column.name,
                    "first": _plain_place(column.first),
                    "largest": _plain_place(column.largest),
                }
                for column in columns
            ]
            for columns in (self.columns, self.clocked)
        )
        return {"equal": self.equal} | asdict(self) | {"columns": columns, "clocked": clocked}


def difference(one: Path, other: Path) -> Difference:
    """Compare two logs, complete or torn.

    Raises:
        LogError: one cannot be read, or holds not one tick.
    """
    a, b = read_recorded(one), read_recorded(other)
    widths = {
        name: (a.layout.widths[name], b.layout.widths[name])
        for name in a.layout.widths
        if a.layout.widths[name] != b.layout.widths[name]
    }
    found = [_column(a, b, name) for name in a.trace if name not in widths]
    columns = sorted((c for c in found if c), key=lambda column: column.first.tick)
    ends = [f"{r.trace.info.status} {r.trace.info.reason}".strip() for r in (a, b)]
    return Difference(
        ticks=(len(a.trace), len(b.trace)),
        columns=tuple(c for c in columns if c.name not in CLOCKED),
        widths=widths,
        scenario={dotted(path): pair for path, pair in _keys(*map(_plain, (a, b)))},
        status=(ends[0], ends[1]) if ends[0] != ends[1] else None,
        events=_events(a, b),
        snapshots=tuple(_snapshots(a, b)),
        files=tuple(n for n in sorted({*a.files, *b.files}) if a.files.get(n) != b.files.get(n)),
        clocked=tuple(c for c in columns if c.name in CLOCKED),
        versions=_versions(a, b),
    )


def rows_differ(one: Array, other: Array) -> Array:
    """Which of N rows differ in any bit: (N,) of bool; both of the same shape and type."""
    return np.asarray(_bits_differ(one, other).any(axis=1))


def _bits_differ(one: Array, other: Array) -> Array:
    """Which entries differ: (N, width) of bool."""
    bits = [np.ascontiguousarray(rows).view(f"u{rows.itemsize}") for rows in (one, other)]
    differ: Array = (bits[0] != bits[1]).reshape(len(one), -1)
    return differ


def _column(a: Recorded, b: Recorded, name: str) -> ColumnDifference | None:
    ticks = min(len(a.trace), len(b.trace))
    one, other = (recorded.trace[name][:ticks] for recorded in (a, b))
    differ = _bits_differ(one, other)
    if not differ.any():
        return None
    one, other = (np.asarray(rows, float).reshape(ticks, -1) for rows in (one, other))

    with np.errstate(invalid="ignore", over="ignore"):
        apart = np.nan_to_num(np.abs(one - other), nan=np.inf)

    def place(index: int) -> Place:
        tick, entry = divmod(index, one.shape[1])
        values = float(one[tick, entry]), float(other[tick, entry])
        return Place(tick, float(a.trace["t"][tick]), entry, values)

    size = np.where(differ, apart, -1.0)
    return ColumnDifference(name, place(int(np.argmax(differ))), place(int(np.argmax(size))))


def _plain(recorded: Recorded) -> Any:
    return recorded.trace.scenario.model_dump(mode="json")


def _keys(a: Any, b: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[Any, Any]]:
    """Key paths at which two scenarios differ, and both values; None where one has no such key."""
    if isinstance(a, dict) and isinstance(b, dict):
        for key in [*a, *(key for key in b if key not in a)]:
            yield from _keys(a.get(key), b.get(key), (*path, key))
    elif a != b:
        yield path, (a, b)


def _events(a: Recorded, b: Recorded) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Events of one log alone, in words, and of the other."""
    told = [
        [f"{event.t:.6g} s: {event.level}: {event.message}" for event in recorded.trace.events]
        for recorded in (a, b)
    ]
    return _without(told[0], told[1]), _without(told[1], told[0])


def _without(items: Sequence[str], others: Sequence[str]) -> tuple[str, ...]:
    left = list(others)
    alone = []
    for item in items:
        if item in left:
            left.remove(item)
        else:
            alone.append(item)
    return tuple(alone)


def _snapshots(a: Recorded, b: Recorded) -> Iterator[str]:
    """A line for each snapshot that differs; those of the same time are compared."""
    one, other = ({(_time(r, key), key[1]): key for key in r.snapshots} for r in (a, b))
    for t, name in sorted({*one, *other}):
        keys = one.get((t, name)), other.get((t, name))
        if keys[0] is None or keys[1] is None:
            told = _alone(keys[0] is not None)
        elif a.snapshots[keys[0]] != b.snapshots[keys[1]]:
            told = ", ".join(_arrays(a.arrays(*keys[0]), b.arrays(*keys[1])))
        else:
            continue
        yield f"{name} at {t:g} s: {told}"


def _time(recorded: Recorded, key: tuple[int, str]) -> float:
    """When a snapshot was taken (s), to the nanosecond: steps of two lengths meet there."""
    return round(key[0] * recorded.trace.scenario.dt, 9)


def _arrays(one: Mapping[str, Array], other: Mapping[str, Array]) -> Iterator[str]:
    for key in sorted({*one, *other}):
        if key not in one or key not in other:
            yield f"{key} {_alone(key in one)}"
        elif one[key].shape != other[key].shape:
            yield f"{key} of shape {one[key].shape}, and {other[key].shape}"
        elif one[key].dtype != other[key].dtype:
            yield f"{key} of type {one[key].dtype}, and {other[key].dtype}"
        elif one[key].tobytes() != other[key].tobytes():
            numbers = one[key].dtype.kind in "biuf"
            yield f"{key} by up to {_largest(one[key], other[key]):.3g}" if numbers else key


def _largest(one: Array, other: Array) -> float:
    with np.errstate(invalid="ignore", over="ignore"):
        return float(np.abs(one.astype(float) - other.astype(float)).max())


def _alone(in_first: bool) -> str:
    return f"in the {'first' if in_first else 'second'} log alone"


def _versions(a: Recorded, b: Recorded) -> dict[str, tuple[str, str]]:
    infos = [recorded.trace.info for recorded in (a, b)]
    one, other = ({**info.versions, "commit": info.git_commit} for info in infos)
    return {
        name: (one.get(name, ""), other.get(name, ""))
        for name in {**one, **other}
        if one.get(name, "") != other.get(name, "")
    }


def _plain_place(place: Place) -> dict[str, Any]:
    numbers = {"a": place.values[0], "b": place.values[1], "difference": place.difference}
    texts = {name: v if np.isfinite(v) else str(v) for name, v in numbers.items()}
    return {"tick": place.tick, "t": place.t, "entry": place.entry, **texts}
