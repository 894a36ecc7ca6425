"""The readable part of an MCAP file, whether complete, torn or damaged."""

# mypy: untyped-calls-exclude=mcap
from __future__ import annotations

import io
import mmap
import stat
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, DataEnd, Footer, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from dnnmso_mj.errors import LogError
from dnnmso_mj.log.messages import RECORD, Messages, unpack
from dnnmso_mj.log.writer import LogWriter

Record = Schema | Channel | Messages | Metadata | Attachment | DataEnd

_KINDS: dict[int, type[Any]] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
    Opcode.ATTACHMENT: Attachment,
    Opcode.CHUNK: Chunk,
    Opcode.DATA_END: DataEnd,
    Opcode.FOOTER: Footer,
}


class Prefix:
    """The records of an MCAP file up to its end, or up to where it is torn or damaged.

    Of a complete file the summary's schemas and channels come again, after DataEnd. `complete`
    says, after a pass, whether the file's end was reached.

    Args:
        path: the file.

    Raises:
        LogError: it is missing, unreadable, not a regular file, empty or something else.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = _size_of_mcap(path)
        self.complete = False

    def __iter__(self) -> Iterator[Record]:
        with (
            self.path.open("rb") as file,
            mmap.mmap(file.fileno(), self.size, access=mmap.ACCESS_READ) as data,
        ):
            records = self._records(data)
            while True:
                try:
                    record = next(records)
                except StopIteration:
                    self.complete = True
                    return
                except Exception:  # the library lets through whatever damaged bytes provoke
                    return
                yield record

    def _records(self, data: mmap.mmap) -> Iterator[Record]:
        """All records that matter, checksums compared; any exception means damage."""
        at = len(MCAP0_MAGIC)
        crc = zlib.crc32(MCAP0_MAGIC)
        while True:
            opcode, length = RECORD.unpack_from(data, at)
            end = at + RECORD.size + length
            if end > self.size:
                raise ValueError("torn")
            whole = data[at:end]
            record = _parsed(opcode, whole)
            if isinstance(record, DataEnd) and record.data_section_crc not in (0, crc):
                raise ValueError("damaged")
            if isinstance(record, Footer):
                if data[end : end + len(MCAP0_MAGIC)] != MCAP0_MAGIC:
                    raise ValueError("torn")
                return
            crc, at = zlib.crc32(whole, crc), end
            if isinstance(record, Chunk):
                stream, size = get_chunk_data_stream(record, validate_crc=True)
                yield from unpack(stream.read(size))
            elif opcode == Opcode.MESSAGE:
                yield from unpack(whole)
            elif record is not None:
                yield record


def _parsed(opcode: int, record: bytes) -> Record | Chunk | Footer | None:
    """A record of one of the kinds that matter here; else None."""
    kind = _KINDS.get(opcode)
    return kind.read(ReadDataStream(io.BytesIO(record[RECORD.size :]))) if kind else None


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
            case DataEnd():
                return  # what follows repeats and indexes what came before
            case Schema() if record.id not in schemas:
                schemas[record.id] = writer.add_schema(record.name, record.encoding, record.data)
            case Channel() if record.id not in channels:
                schema = schemas.get(record.schema_id, 0)  # 0: none
                channels[record.id] = writer.add_channel(
                    record.topic, record.message_encoding, schema
                )
            case Messages() if record.channel_id in channels:
                writer.add_messages(replace(record, channel_id=channels[record.channel_id]))
            case Metadata() if record.name != leave_out:
                writer.add_metadata(record.name, record.metadata)
            case Attachment(_, time, name, media_type, data):
                writer.add_attachment(time, name, media_type, data)


def _size_of_mcap(path: Path) -> int:
    """The size of the file in bytes, once it has shown to begin like an MCAP.

    Raises:
        LogError: it is missing, unreadable, not a regular file, empty or something else.
    """
    hint = "Give a log that `dnnmso run` wrote."
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):  # opening a FIFO would wait for a writer
            kind = "a directory" if stat.S_ISDIR(status.st_mode) else "not a regular file"
            raise LogError(f"{path} is {kind}; allowed: an MCAP file. {hint}")
        with path.open("rb") as file:
            magic = file.read(len(MCAP0_MAGIC))
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror or error}. {hint}") from error
    if magic != MCAP0_MAGIC:
        found = f"begins with {magic!r}" if magic else "is empty"
        raise LogError(f"{path} {found}; expected an MCAP file. {hint}")
    return status.st_size
