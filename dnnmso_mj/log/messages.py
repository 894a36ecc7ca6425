"""Messages of one size, many at once, to and from the bytes that MCAP has for them.

A run's messages all have the same size, so in a chunk their records are a packed table: a constant
header, two times, a number and the data. NumPy lays out and reads such a table in one go, where a
library that handles messages singly takes 10 µs for each.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from dnnmso_mj.log import records
from dnnmso_mj.log.records import DamagedError

Array = np.ndarray

RECORD = struct.Struct("<BQ")  # opcode and length, which open every record
_HEADER = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel_id", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
_SAME = RECORD.size + 2  # bytes that messages of one channel and one size begin with
HEADER_SIZE = _HEADER.itemsize
_ONE = struct.Struct("<BQHIQQ")


@dataclass(frozen=True)
class Messages:
    """Messages of one channel and one size, in their order; each is published when it is logged."""

    channel_id: int
    time_ns: Array  # (N,) uint64
    sequence: Array  # (N,) uint32
    data: Array  # (N, size) uint8

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, part: slice) -> Messages:
        return Messages(self.channel_id, self.time_ns[part], self.sequence[part], self.data[part])


def pack(messages: Messages) -> bytes:
    """The MCAP records of messages, one after the other."""
    count, size = messages.data.shape
    table = np.empty((count, HEADER_SIZE + size), dtype=np.uint8)
    header = table[:, :HEADER_SIZE].view(_HEADER)[:, 0]
    header["opcode"], header["length"] = Opcode.MESSAGE, HEADER_SIZE - RECORD.size + size
    header["channel_id"], header["sequence"] = messages.channel_id, messages.sequence
    header["log_time"] = header["publish_time"] = messages.time_ns
    table[:, HEADER_SIZE:] = messages.data
    return table.tobytes()


def pack_one(channel_id: int, time_ns: int, data: bytes) -> bytes:
    """The MCAP record of a single message, of number 0."""
    length = HEADER_SIZE - RECORD.size + len(data)
    return _ONE.pack(Opcode.MESSAGE, length, channel_id, 0, time_ns, time_ns) + data


def unpack(chunk: bytes) -> Iterator[Messages | Schema | Channel]:
    """The records of a chunk's content; messages that are alike come together.

    Raises:
        DamagedError: the bytes are no such records.
    """
    at = 0
    while at < len(chunk):
        if len(chunk) - at < RECORD.size:
            raise DamagedError("a record that ends behind its chunk")
        opcode, length = RECORD.unpack_from(chunk, at)
        end = at + RECORD.size + length
        if end > len(chunk):
            raise DamagedError("a record that ends behind its chunk")
        body = memoryview(chunk)[at + RECORD.size : end]
        if opcode == Opcode.MESSAGE:
            table = _table(chunk, at, end - at)
            header = table[:, :HEADER_SIZE].view(_HEADER)[:, 0]
            yield Messages(
                channel_id=int(header["channel_id"][0]),
                time_ns=header["log_time"],
                sequence=header["sequence"],
                data=table[:, HEADER_SIZE:],
            )
            end = at + table.size
        elif opcode == Opcode.SCHEMA:
            yield records.schema(body)
        elif opcode == Opcode.CHANNEL:
            yield records.channel(body)
        else:
            raise DamagedError(f"a record of kind {opcode} in a chunk")
        at = end


def _table(chunk: bytes, at: int, stride: int) -> Array:
    """The message record at `at` and those behind it of its channel and size, (N, stride)."""
    if stride < HEADER_SIZE:
        raise DamagedError("a message that ends in its header")
    most = (len(chunk) - at) // stride
    table = np.frombuffer(chunk, np.uint8, most * stride, at).reshape(most, stride)
    count, ahead = 1, 16  # looking twice as far each time: few are found as fast as many
    while count < most:
        alike = (table[count : count + ahead, :_SAME] == table[0, :_SAME]).all(axis=1)
        if not alike.all():
            return table[: count + int(alike.argmin())]
        count, ahead = count + len(alike), 2 * ahead
    return table
