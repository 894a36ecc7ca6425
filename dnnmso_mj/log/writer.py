"""An MCAP file written block by block: chunks end where the caller says, and blocks are cheap.

The records are those of the MCAP specification (mcap.dev/spec) and are written by the mcap
library's classes, but for the messages and their indexes, which `dnnmso_mj.log.messages` lays out
many at once. That is why this is not the library's writer: it takes single messages only.
"""

# mypy: untyped-calls-exclude=mcap
from __future__ import annotations

import zlib
from collections import defaultdict
from collections.abc import Iterable
from typing import BinaryIO

import lz4.frame
import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from dnnmso_mj import __version__
from dnnmso_mj.log.messages import HEADER_SIZE, RECORD, Messages, pack, pack_one

_INDEXES = (Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX)
CHUNK_BYTES = 64 * 1024  # small enough to be compressed within a control period


class LogWriter:
    """Writes an MCAP file with lz4 chunks, all indexes and all checksums.

    Args:
        file: open for writing, and empty; stays open.

    Every method raises OSError where the file cannot be written.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._size = 0
        self._crc = 0
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunk: list[bytes] = []
        self._chunk_size = 0
        self._index: dict[int, list[bytes]] = defaultdict(list)  # channel -> times and places
        self._span: tuple[int, int] | None = None  # ns, of the chunk
        self._indexes = {
            opcode: bytearray() for opcode in _INDEXES
        }  # as bytes: they grow with a run
        self._indexed = dict.fromkeys(_INDEXES, 0)
        self._logged: tuple[int, int] | None = None  # ns, of all chunks
        self._counts: dict[int, int] = defaultdict(int)  # channel -> messages
        self._put(MCAP0_MAGIC)
        self._put(_bytes(Header(profile="", library=f"dnnmso_mj {__version__}")))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema; returns its number."""
        schema = Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        self._append(_bytes(schema))
        return schema.id

    def add_channel(self, topic: str, encoding: str, schema_id: int) -> int:
        """Add a channel of messages of a schema (0: none); returns its number."""
        number = len(self._channels) + 1
        channel = Channel(
            id=number, topic=topic, message_encoding=encoding, metadata={}, schema_id=schema_id
        )
        self._channels.append(channel)
        self._append(_bytes(channel))
        return number

    def add_message(self, channel_id: int, time_ns: int, data: bytes) -> None:
        """Add a message of number 0."""
        self._make_room(HEADER_SIZE + len(data))
        self._index[channel_id].append(np.array([time_ns, self._chunk_size], "<u8").tobytes())
        self._count(channel_id, 1, time_ns, time_ns)
        self._append(pack_one(channel_id, time_ns, data))

    def add_messages(self, messages: Messages) -> None:
        """Add messages; they all go into one chunk."""
        stride = HEADER_SIZE + messages.data.shape[1]
        self._make_room(stride * len(messages))
        index = np.empty((len(messages), 2), dtype="<u8")
        index[:, 0] = messages.time_ns
        index[:, 1] = self._chunk_size + stride * np.arange(len(messages))
        self._index[messages.channel_id].append(index.tobytes())
        first, last = int(messages.time_ns.min()), int(messages.time_ns.max())
        self._count(messages.channel_id, len(messages), first, last)
        self._append(pack(messages))

    def add_attachment(self, time_ns: int, name: str, media_type: str, data: bytes) -> None:
        """Write a file that belongs to the log, as of a time (ns)."""
        record = _bytes(Attachment(time_ns, time_ns, name, media_type, data))
        place, size = self._put(record)
        index = AttachmentIndex(place, size, time_ns, time_ns, len(data), name, media_type)
        self._add_index(Opcode.ATTACHMENT_INDEX, index)

    def add_metadata(self, name: str, data: dict[str, str]) -> None:
        """Write names and values."""
        place, size = self._put(_bytes(Metadata(name=name, metadata=data)))
        index = MetadataIndex(offset=place, length=size, name=name)
        self._add_index(Opcode.METADATA_INDEX, index)

    def flush(self) -> None:
        """End the chunk in progress, and hand everything to the operating system."""
        self._end_chunk()
        self._file.flush()

    def finish(self) -> None:
        """Write the summary and the end of the file."""
        self._end_chunk()
        self._put(_bytes(DataEnd(self._crc)))
        start = self._size
        groups: dict[Opcode, bytes | bytearray] = {
            Opcode.SCHEMA: b"".join(map(_bytes, self._schemas)),
            Opcode.CHANNEL: b"".join(map(_bytes, self._channels)),
            Opcode.STATISTICS: _bytes(self._statistics()),
            **self._indexes,
        }
        summary, offsets = bytearray(), b""
        for opcode, group in groups.items():
            if group:
                offsets += _bytes(SummaryOffset(opcode, start + len(summary), len(group)))
                summary += group
        footer = Footer(
            summary_start=start, summary_offset_start=start + len(summary), summary_crc=0
        )
        summary += offsets
        # The footer's checksum covers the footer itself up to the checksum.
        footer.summary_crc = zlib.crc32(summary + _bytes(footer)[:-4])
        self._put(bytes(summary) + _bytes(footer) + MCAP0_MAGIC)
        self._file.flush()

    def _put(self, data: bytes) -> tuple[int, int]:
        """Write bytes; returns their place and number."""
        self._file.write(data)
        self._crc = zlib.crc32(data, self._crc)
        place = self._size
        self._size += len(data)
        return place, len(data)

    def _append(self, record: bytes) -> None:
        self._chunk.append(record)
        self._chunk_size += len(record)

    def _make_room(self, size: int) -> None:
        if self._chunk_size + size > CHUNK_BYTES:
            self._end_chunk()

    def _count(self, channel_id: int, count: int, first: int, last: int) -> None:
        self._counts[channel_id] += count
        low, high = self._span or (first, last)
        self._span = min(low, first), max(high, last)

    def _end_chunk(self) -> None:
        if self._span is None:
            return  # schemas and channels wait for the first message
        start, end = self._span
        content = b"".join(self._chunk)
        chunk = Chunk(
            compression="lz4",
            data=lz4.frame.compress(content),
            message_start_time=start,
            message_end_time=end,
            uncompressed_crc=zlib.crc32(content),
            uncompressed_size=len(content),
        )
        place, size = self._put(_bytes(chunk))
        offsets = {id: self._put(_message_index(id, at))[0] for id, at in self._index.items()}
        index = ChunkIndex(
            chunk_length=size,
            chunk_start_offset=place,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            message_end_time=end,
            message_index_length=self._size - place - size,
            message_index_offsets=offsets,
            message_start_time=start,
            uncompressed_size=len(content),
        )
        self._add_index(Opcode.CHUNK_INDEX, index)
        first, last = self._logged or (start, end)
        self._logged = min(first, start), max(last, end)
        self._chunk, self._chunk_size, self._span = [], 0, None
        self._index.clear()

    def _add_index(self, opcode: Opcode, record: McapRecord) -> None:
        self._indexes[opcode] += _bytes(record)
        self._indexed[opcode] += 1

    def _statistics(self) -> Statistics:
        start, end = self._logged or (0, 0)
        return Statistics(
            attachment_count=self._indexed[Opcode.ATTACHMENT_INDEX],
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=self._indexed[Opcode.CHUNK_INDEX],
            message_count=sum(self._counts.values()),
            message_end_time=end,
            message_start_time=start,
            metadata_count=self._indexed[Opcode.METADATA_INDEX],
            schema_count=len(self._schemas),
        )


def _message_index(channel_id: int, entries: Iterable[bytes]) -> bytes:
    """The index of a chunk's messages on a channel: pairs of time and place."""
    pairs = b"".join(entries)
    content = channel_id.to_bytes(2, "little") + len(pairs).to_bytes(4, "little") + pairs
    return RECORD.pack(Opcode.MESSAGE_INDEX, len(content)) + content


def _bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()
    return data
