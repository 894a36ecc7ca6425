"""The readable part of an MCAP file, whether complete, torn or damaged.

Nothing behind the first damage is given, since what is missing there would not be seen. So nothing
is passed over either: kinds of records that do not belong where they stand, and numbers of messages
that do not follow one another, are damage as much as a wrong checksum.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import replace
from io import BufferedReader
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from dnnmso_mj.log import limits, records
from dnnmso_mj.log.messages import RECORD, Messages, unpack
from dnnmso_mj.log.opening import open_mcap, unreadable
from dnnmso_mj.log.records import DamagedError
from dnnmso_mj.log.writer import LogWriter

Record = Schema | Channel | Messages | Metadata | Attachment

LARGEST: dict[int, int] = {  # bytes of a record, by its kind; others may have all of the file
    Opcode.CHUNK: limits.CHUNK + limits.MIB,
    Opcode.MESSAGE: limits.CHUNK,
    Opcode.SCHEMA: limits.DEFINITIONS,
    Opcode.CHANNEL: limits.DEFINITIONS,
}
SUMMARY = frozenset({
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.STATISTICS,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET,
})  # fmt: skip


class Prefix:
    """The records of an MCAP file up to its end, or up to where it is torn or damaged.

    The first schema and channel of each number are given, and messages of channels that are known.
    `complete` says, after a pass, whether the file's end was reached and every checksum held.

    Args:
        path: the file.

    Raises:
        LogError: it is missing, unreadable, not a regular file, empty or something else; in a pass,
            also where it holds more than a log may.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with open_mcap(path) as (_, size):
            self.size = size
        self.complete = False

    def __iter__(self) -> Iterator[Record]:
        self.complete = False
        with open_mcap(self.path) as (file, size):
            try:
                yield from _Walk(self.path, file, size)
            except DamagedError:
                return
        self.complete = True


class _Walk:
    """One pass over a file, its checksums compared; DamagedError where it goes no further."""

    def __init__(self, path: Path, file: BufferedReader, size: int) -> None:
        self._file, self._size = _Source(path, file, size), size
        self._order = _Order()
        self._path = path
        self._known: set[tuple[type, int]] = set()  # kind and number of definitions
        self._metadata = self._definitions = self._contents = self._runs = 0

    def __iter__(self) -> Iterator[Record]:
        opcode, _ = self._file.next()
        if opcode != Opcode.HEADER:
            raise DamagedError("no header")
        while True:
            before = self._file.crc
            opcode, body = self._file.next()
            if opcode == Opcode.DATA_END:
                break
            yield from self._data(opcode, body)
        if body != before.to_bytes(4, "little"):
            raise DamagedError("the data are not what their checksum says")
        self._file.check_summary()

    def _data(self, opcode: int, body: bytes) -> Iterator[Record]:
        """What one record gives, of those that stand before the summary."""
        match opcode:
            case Opcode.CHUNK:
                yield from self._unpacked(records.chunk(body))
            case Opcode.MESSAGE:  # of other programs: ours are in chunks, which have checksums
                if self._contents:
                    raise DamagedError("a message outside the chunks")
                yield from self._checked(next(unpack(RECORD.pack(opcode, len(body)) + body)))
            case Opcode.MESSAGE_INDEX:
                records.check_index(body)
            case Opcode.SCHEMA:
                yield from self._checked(records.schema(body))
            case Opcode.CHANNEL:
                yield from self._checked(records.channel(body))
            case Opcode.METADATA:
                records.check_metadata(body)
                self._metadata += len(body)
                self._allow("bytes of metadata", self._metadata, limits.METADATA)
                yield records.metadata(body)
            case Opcode.ATTACHMENT:
                yield records.attachment(body)
            case _:
                raise DamagedError(f"a record of kind {opcode} among the data")

    def _unpacked(self, content: bytes) -> Iterator[Record]:
        self._contents += len(content)
        self._allow("bytes in chunks", self._contents, limits.contents(self._size))
        for record in unpack(content):
            yield from self._checked(record)

    def _checked(self, record: Schema | Channel | Messages) -> Iterator[Record]:
        """Definitions that are new, and messages as far as they follow one another."""
        self._runs += 1
        self._allow("runs of like messages", self._runs, limits.runs(self._size))
        if not isinstance(record, Messages):
            if (type(record), record.id) not in self._known:
                self._known.add((type(record), record.id))
                self._definitions += records.size(record)
                self._allow("bytes of definitions", self._definitions, limits.DEFINITIONS)
                yield record
            return
        if (Channel, record.channel_id) not in self._known:
            raise DamagedError("messages of no channel")
        good = self._order.following(record)
        if good:
            yield record[:good]
        if good < len(record):
            raise DamagedError("messages are missing, or not in their order")

    def _allow(self, what: str, found: int, most: int) -> None:
        if found > most:
            raise limits.too_much(self._path, what, most, self._size)


class _Source:
    """The records of a file, one after the other, and the checksum of what has been read."""

    def __init__(self, path: Path, file: BufferedReader, size: int) -> None:
        self._path, self._file, self._size = path, file, size
        self._at = len(MCAP0_MAGIC)
        self.crc = zlib.crc32(MCAP0_MAGIC)  # of all before `_at`

    def next(self) -> tuple[int, bytes]:
        """The next record: its kind, and its bytes behind kind and length."""
        head = self._read(RECORD.size)
        opcode, length = RECORD.unpack(head)
        if length > LARGEST.get(opcode, self._size):
            raise DamagedError("a record that is longer than its kind may be")
        body = self._read(length)
        self.crc = zlib.crc32(body, zlib.crc32(head, self.crc))
        return opcode, body

    def check_summary(self) -> None:
        """Read on to the end of the file: the summary's checksum, and the magic bytes."""
        start, crc, opcode = self._at, 0, int(Opcode.DATA_END)
        while opcode != Opcode.FOOTER:
            opcode, body = self.next()
            if opcode not in SUMMARY and opcode != Opcode.FOOTER:
                raise DamagedError(f"a record of kind {opcode} in the summary")
            record = RECORD.pack(opcode, len(body)) + body
            before, crc = crc, zlib.crc32(record, crc)
        fields = records.Fields(body)
        found, _, said = fields.number(8), fields.number(8), fields.number(4)
        fields.end()
        if said != zlib.crc32(record[:-4], before) or found not in (start, 0):
            raise DamagedError("the summary is not what its checksum says")
        if self._read(len(MCAP0_MAGIC)) != MCAP0_MAGIC or self._at != self._size:
            raise DamagedError("no end, or something behind it")

    def _read(self, size: int) -> bytes:
        if size > self._size - self._at:
            raise DamagedError("torn")
        try:
            data = self._file.read(size)
        except OSError as error:
            raise unreadable(self._path, error) from error
        if len(data) < size:
            raise DamagedError("the file was cut while it was read")
        self._at += size
        return data


class _Order:
    """Whether the messages of a channel are all there: numbered from 0 on, or not at all."""

    def __init__(self) -> None:
        self._counts: dict[int, int] = {}  # channel -> messages
        self._unnumbered: set[int] = set()  # channels of other programs; of ours: all but /step

    def following(self, messages: Messages) -> int:
        """How many of these come as they must."""
        channel, numbers = messages.channel_id, messages.sequence
        count = self._counts.get(channel, 0)
        if count <= 1 < count + len(numbers) and not numbers.any():
            self._unnumbered.add(channel)
        expected = 0 if channel in self._unnumbered else count + np.arange(len(numbers))
        right = numbers == expected
        good = len(right) if right.all() else int(right.argmin())
        self._counts[channel] = count + good
        return good


def copy(prefix: Prefix, writer: LogWriter, leave_out: str | None = None) -> None:
    """Copy schemas, channels, messages, attachments and metadata; indexes are made anew.

    Args:
        prefix: where from.
        writer: where to.
        leave_out: the name of a metadata record that is not copied.
    """
    schemas: dict[int, int] = {}  # old id -> new id
    channels: dict[int, int] = {}
    for record in prefix:
        match record:
            case Schema():
                schemas[record.id] = writer.add_schema(record.name, record.encoding, record.data)
            case Channel():
                schema = schemas.get(record.schema_id, 0)  # 0: none
                channels[record.id] = writer.add_channel(
                    record.topic, record.message_encoding, schema
                )
            case Messages():
                writer.add_messages(replace(record, channel_id=channels[record.channel_id]))
            case Metadata() if record.name != leave_out:
                writer.add_metadata(record.name, record.metadata)
            case Attachment(_, time, name, media_type, data):
                writer.add_attachment(time, name, media_type, data)
