"""Messages from one process to another through memory that both share.

The writer copies and returns: it waits for nobody, wakes nobody and makes no system call. What a
full ring has no room for is refused, so that a reader that is slow, stopped or gone costs the
writer nothing.
"""

from __future__ import annotations

import mmap
import os
import struct
import tempfile
from collections.abc import Iterator

_HEAD, _TAIL, _TALLY, _CLOSED = range(4)  # of the header: bytes put and taken, and two words back
_HEADER_BYTES = 64
_FRAME = struct.Struct("<qq")  # before each message: its kind and its length


def shared_memory(capacity: int) -> int:
    """Memory for a `Ring` of so many bytes, as a file descriptor to give to the other process.

    Pages that are never written cost nothing.
    """
    if hasattr(os, "memfd_create"):
        memory = os.memfd_create("dnnmso-ring")
    else:
        with tempfile.TemporaryFile() as file:
            memory = os.dup(file.fileno())
    os.ftruncate(memory, _HEADER_BYTES + capacity)
    return memory


class Ring:
    """The ring in such memory, for one writer and one reader.

    N.B. the writer's numbers are stored after the bytes they speak of, which x86 lets no reader see
    in another order; elsewhere the microseconds between two lines of Python must do.

    Args:
        memory: as `shared_memory` gave it; it may be closed afterwards.
    """

    def __init__(self, memory: int) -> None:
        view = memoryview(mmap.mmap(memory, 0))
        self._words = view[:_HEADER_BYTES].cast("q")
        self._bytes = view[_HEADER_BYTES:]

    @property
    def tally(self) -> int:
        """A number that the reader sets and the writer reads: how much of it has been useful."""
        return self._words[_TALLY]

    @tally.setter
    def tally(self, value: int) -> None:
        self._words[_TALLY] = value

    @property
    def closed(self) -> bool:
        """Whether the reader wants no more."""
        return bool(self._words[_CLOSED])

    def close(self) -> None:
        """Refuse everything from now on; the reader's to call."""
        self._words[_CLOSED] = 1

    def warm(self, size: int) -> None:
        """Have the first `size` bytes in memory, so that no `put` waits for the system's pages."""
        pages = self._bytes[: size : mmap.PAGESIZE]
        pages[:] = bytes(len(pages))

    def put(self, kind: int, message: memoryview | bytes) -> bool:
        """Add a message; False where there is no room for it, or the reader wants no more."""
        head, needed = self._words[_HEAD], _FRAME.size + len(message)
        if self.closed or head + needed - self._words[_TAIL] > len(self._bytes):
            return False
        self._write(head, _FRAME.pack(kind, len(message)))
        self._write(head + _FRAME.size, message)
        self._words[_HEAD] = head + needed
        return True

    def take(self, limit: int) -> Iterator[tuple[int, bytes]]:
        """Kind and content of the messages that wait now, the oldest first.

        Args:
            limit: no further one once they hold so many bytes.
        """
        head, tail = self._words[_HEAD], self._words[_TAIL]
        end = min(head, tail + limit)
        while tail < end:
            kind, length = _FRAME.unpack(self._read(tail, _FRAME.size))
            message = self._read(tail + _FRAME.size, length)
            tail += _FRAME.size + length
            self._words[_TAIL] = tail  # its room may be written again
            yield kind, message

    def _write(self, position: int, data: memoryview | bytes) -> None:
        start = position % len(self._bytes)
        room = len(self._bytes) - start  # before it goes on from the beginning
        if len(data) <= room:
            self._bytes[start : start + len(data)] = data
        else:
            self._bytes[start:] = data[:room]
            self._bytes[: len(data) - room] = data[room:]

    def _read(self, position: int, length: int) -> bytes:
        start = position % len(self._bytes)
        first = bytes(self._bytes[start : start + length])
        return first + bytes(self._bytes[: length - len(first)])
