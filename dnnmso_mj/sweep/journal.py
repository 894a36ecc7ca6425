"""What a sweep has done so far, kept beside its table from run to run, whatever happens.

One line of JSON a run, after a first line that says of which sweep, and in the file as soon as the
run is finished: a kill costs the runs under way. The lock on the file is the sweep's hold on its
table; it goes with the process.
"""

from __future__ import annotations

import fcntl
import json
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn, Protocol, Self

import pyarrow as pa
import pyarrow.json

from dnnmso_mj.sweep.plan import SweepError, seeds_text
from dnnmso_mj.sweep.table import SWEEP, Kind, is_table, read_table, unfinished_rows, write_table
from dnnmso_mj.sweep.task import Row
from dnnmso_mj.wording import show

SYNC_PERIOD = 1.0  # s; of what the machine's own end may cost
LISTED = 8
BEGINNING = b'{"points": ['  # of every journal: a plan's definition as JSON


class Planned(Protocol):
    """What the rows of a table are to be of."""

    @property
    def points(self) -> Sequence[object]:
        """Each has a row of every seed."""

    @property
    def seeds(self) -> tuple[int, ...]:
        """Ascending, each once."""

    def definition(self) -> dict[str, Any]:
        """Everything but the seeds that the numbers depend on, as JSON; the first key is points."""


def journal_path(out: Path) -> Path:
    """Where the rows of an unfinished sweep are."""
    return out.with_name(f"{out.name}.journal")


class Journal:
    """The rows of one sweep on their way to `out`; a context manager that holds the lock.

    Left with no row at all, or after `remove`, it leaves no file.

    Args:
        out: the table to be.
        plan: what is swept.
        kind: of the table.
        resume: whether to go on from what a journal or a finished table of the same plan holds.
        force: whether to start anew in spite of either.

    Raises:
        SweepError: `out` is taken, another sweep is writing it, what is there is of another sweep,
            or the file cannot be written.
    """

    def __init__(
        self,
        out: Path,
        plan: Planned,
        kind: Kind = SWEEP,
        *,
        resume: bool = False,
        force: bool = False,
    ) -> None:
        if out.is_dir():
            raise SweepError(f"{out}: a folder; allowed: a file, as in sweep.parquet")
        self.out, self._plan, self._kind = out, plan, kind
        self._path = journal_path(out)
        self._synced = time.monotonic()
        self._replaces = out.exists()
        self.done: list[set[int]] = [set() for _ in plan.points]
        if out.exists() and not is_table(out, kind):
            _refuse_foreign(out, f"a table of `{kind.command}`")
        if out.exists() and not (resume or force):
            raise SweepError(f"{out}: exists; {_ways_out('a finished sweep')}")
        if self._path.exists() and not _is_journal(self._path):
            _refuse_foreign(self._path, f"a journal of `{kind.command}`")
        with _writing(self._path):
            out.parent.mkdir(parents=True, exist_ok=True)
            self._file = _lock(self._path)
        self._first_row = 0  # where the rows begin in the file
        try:
            self._begin(resume, force)
        except BaseException:
            if self._size() == 0:
                self.remove()
            os.close(self._file)
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        _error: BaseException | None,
        _traceback: TracebackType | None,
    ) -> None:
        if self._size() <= self._first_row:
            self.remove()
        os.close(self._file)

    @property
    def n_done(self) -> int:
        """How many rows are kept."""
        return sum(map(len, self.done))

    def append(self, row: Row) -> None:
        """Keep one row; when this returns, no kill of the process can take it back."""
        self._write(json.dumps(row, allow_nan=False))
        self.done[row["point"]].add(row["seed"])
        if time.monotonic() - self._synced > SYNC_PERIOD:
            with _writing(self._path):
                os.fsync(self._file)
            self._synced = time.monotonic()

    def rows(self) -> pa.Table:
        """Every row that is kept, of the kind's schema.

        Raises:
            SweepError: the file has been damaged.
        """
        schema = self._kind.rows
        if self._size() <= self._first_row:
            return schema.empty_table()
        parse = pyarrow.json.ParseOptions(explicit_schema=schema, unexpected_field_behavior="error")
        try:
            with self._path.open("rb") as stream:
                stream.seek(self._first_row)
                table = pyarrow.json.read_json(stream, parse_options=parse)
                return table.select(schema.names).cast(schema)
        except (OSError, pa.ArrowException, ValueError) as error:
            self._damaged(error)

    def publish(self, table: pa.Table) -> None:
        """Write the finished table, and nothing over what has come to its place meanwhile.

        Raises:
            SweepError: it cannot be written; its rows are still here.
        """
        write_table(table, self.out, replace=self._replaces)
        self.remove()

    def remove(self) -> None:
        """Delete the file; its rows are in the table now, or there are none."""
        self._path.unlink(missing_ok=True)

    def _begin(self, resume: bool, force: bool) -> None:
        left = self._whole_lines()
        if left and not (resume or force):
            what = f"an unfinished sweep of {left - 1} runs"
            raise SweepError(f"{self._path}: {what}; {_ways_out(what)}")
        if left and resume:
            self._go_on()
            return
        with _writing(self._path):
            os.ftruncate(self._file, 0)
        finished = resume and self.out.exists()
        rows = self._finished_rows() if finished else self._kind.rows.empty_table()
        self._write(json.dumps(self._plan.definition()))
        self._first_row = self._size()
        for row in rows.to_pylist():
            self.append(row)

    def _go_on(self) -> None:
        """Take over the rows of a journal, if it is of this sweep."""
        with self._path.open("rb") as stream:
            first = stream.readline()
        try:
            before = json.loads(first)
        except ValueError as error:
            self._damaged(error)
        self._check_same(before)
        self._first_row = len(first)
        rows = self.rows()
        self._check_asked(rows)
        points, seeds = rows["point"].to_pylist(), rows["seed"].to_pylist()
        for point, seed in zip(points, seeds, strict=True):
            if not 0 <= point < len(self.done):
                self._damaged(f"a row of point {point}; allowed: 0 to {len(self.done) - 1}")
            if seed in self.done[point]:
                self._damaged(f"point {point} has two rows of seed {seed}")
            self.done[point].add(seed)

    def _finished_rows(self) -> pa.Table:
        """The rows of a finished table, if it is of this sweep."""
        table, provenance = read_table(self.out, self._kind)
        self._check_same(provenance.get("definition"))
        rows = unfinished_rows(table, len(self._plan.points), self._kind)
        self._check_asked(rows)
        return rows

    def _damaged(self, what: object) -> NoReturn:
        raise SweepError(f"{self._path}: damaged: {what}; --force starts anew")

    def _check_same(self, before: Any) -> None:
        now = json.loads(json.dumps(self._plan.definition()))
        found = list(differences(before, now, ""))
        if found:
            more = [f"… and {len(found) - LISTED} more"] if len(found) > LISTED else []
            listed = "\n  ".join(found[:LISTED] + more)
            raise SweepError(
                f"{self.out}: --resume: what is there is of another sweep:\n  {listed}\n"
                "allowed: the same scenario, grid and software; or --force, or another --out"
            )

    def _check_asked(self, rows: pa.Table) -> None:
        extra = sorted(set(rows["seed"].to_pylist()) - set(self._plan.seeds))
        if extra:
            raise SweepError(
                f"{self.out}: --resume: holds seeds that are not asked for: "
                f"{show(seeds_text(extra))[1:-1]}; allowed: --seeds with these and more"
            )

    def _whole_lines(self) -> int:
        """Cut off a line that a kill has torn; how many are left."""
        with _writing(self._path), self._path.open("rb") as stream:
            lines, whole = 0, 0
            for line in stream:
                if not line.endswith(b"\n"):
                    os.ftruncate(self._file, whole)
                    break
                lines, whole = lines + 1, whole + len(line)
        return lines

    def _write(self, line: str) -> None:
        rest = f"{line}\n".encode()
        with _writing(self._path):
            while rest:  # what a full disk took in part says why when the rest is asked of it
                rest = rest[os.write(self._file, rest) :]

    def _size(self) -> int:
        return os.fstat(self._file).st_size


def _lock(path: Path) -> int:
    """Open and lock the file that is at `path` when the lock is held."""
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(file)
            ways = "allowed: wait for it, or another --out"
            raise SweepError(f"{path}: another sweep is writing it now; {ways}") from error
        with suppress(FileNotFoundError):
            if os.path.samestat(path.stat(), os.fstat(file)):
                return file
        os.close(file)  # the sweep that had it has ended and removed it


def _is_journal(path: Path) -> bool:
    """Whether this is a regular file that a sweep began, even if a kill tore its first line."""
    if not path.is_file():
        return False
    with _writing(path), path.open("rb") as stream:
        return BEGINNING.startswith(stream.read(len(BEGINNING)))


def _refuse_foreign(path: Path, kind: str) -> NoReturn:
    raise SweepError(
        f"{path}: exists and is not {kind}, so nothing is written over it; "
        "allowed: another --out, or remove it first"
    )


def _ways_out(what: str) -> str:
    return f"allowed: --resume to go on from {what}, --force to start anew, or another --out"


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise SweepError(f"{path}: cannot be written: {error.strerror or error}") from error


def differences(before: Any, now: Any, path: str) -> Iterator[str]:
    """Where two values of JSON differ, as `key.path: before; now: after`."""
    if isinstance(before, dict) and isinstance(now, dict):
        for key in before | now:
            below = f"{path}.{key}" if path else key
            yield from differences(before.get(key), now.get(key), below)
    elif isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        for k, (one, other) in enumerate(zip(before, now, strict=True)):
            yield from differences(one, other, f"{path}.{k}")
    elif isinstance(before, list) and isinstance(now, list):
        yield f"{path}: {len(before)} entries; now: {len(now)}"
    elif before != now:
        yield f"{path}: {show(before)}; now: {show(now)}"
