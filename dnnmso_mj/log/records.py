"""MCAP records out of bytes that may be damaged: read to the last byte, or refused.

The mcap library's own readers take a record that ends early or late for a whole one, and compare
no attachment's checksum; so what is left out here is how they read, not what they give.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable

import lz4.frame
from mcap.records import Attachment, Channel, Metadata, Schema

from dnnmso_mj.log import limits


class DamagedError(ValueError):
    """Bytes that are not what their place in the file says; no reader lets it out."""


class Fields:
    """The fields of one record, one after the other.

    Args:
        body: the record without its opcode and length.

    Every method raises DamagedError where the record does not have it.
    """

    def __init__(self, body: bytes | memoryview) -> None:
        self._body = memoryview(body)
        self._at = 0

    def take(self, size: int) -> memoryview:
        """The next bytes."""
        end = self._at + size
        if end > len(self._body):
            raise DamagedError("a field that ends behind its record")
        part = self._body[self._at : end]
        self._at = end
        return part

    def number(self, size: int) -> int:
        """An unsigned number of `size` bytes."""
        return int.from_bytes(self.take(size), "little")

    def text(self) -> str:
        """A string behind its length."""
        try:
            return str(self.take(self.number(4)), "utf-8")
        except UnicodeDecodeError as error:
            raise DamagedError("a text that is no UTF-8") from error

    def texts(self) -> dict[str, str]:
        """Names and values behind their length."""
        part = Fields(self.take(self.number(4)))
        found = {}
        while part._at < len(part._body):
            name = part.text()
            found[name] = part.text()
        return found

    def end(self) -> None:
        """Nothing may be left."""
        if self._at != len(self._body):
            raise DamagedError("a record that is longer than its fields")


def schema(body: bytes | memoryview) -> Schema:
    """A record of the kind Schema."""
    fields = Fields(body)
    number, name, encoding = fields.number(2), fields.text(), fields.text()
    data = bytes(fields.take(fields.number(4)))
    fields.end()
    return Schema(id=number, name=name, encoding=encoding, data=data)


def channel(body: bytes | memoryview) -> Channel:
    """A record of the kind Channel."""
    fields = Fields(body)
    number, of = fields.number(2), fields.number(2)
    topic, encoding, metadata = fields.text(), fields.text(), fields.texts()
    fields.end()
    return Channel(
        id=number, schema_id=of, topic=topic, message_encoding=encoding, metadata=metadata
    )


def size(record: Schema | Channel) -> int:
    """About how many bytes a definition has."""
    if isinstance(record, Schema):
        return len(record.name) + len(record.encoding) + len(record.data)
    texts = [record.topic, *record.metadata, *record.metadata.values()]
    return sum(map(len, texts)) + 8 * len(texts)


def metadata(body: bytes | memoryview) -> Metadata:
    """A record of the kind Metadata."""
    fields = Fields(body)
    found = Metadata(name=fields.text(), metadata=fields.texts())
    fields.end()
    return found


def check_metadata(body: bytes | memoryview) -> None:
    """Refuse what is no record of the kind Metadata, without reading its entries."""
    fields = Fields(body)
    fields.take(fields.number(4))
    fields.take(fields.number(4))
    fields.end()


def attachment(body: bytes | memoryview) -> Attachment:
    """A record of the kind Attachment, its checksum compared."""
    fields = Fields(body)
    logged, created = fields.number(8), fields.number(8)
    name, media_type = fields.text(), fields.text()
    data = fields.take(fields.number(8))
    crc = fields.number(4)
    fields.end()
    if zlib.crc32(memoryview(body)[:-4]) != crc:
        raise DamagedError("an attachment that is not what its checksum says")
    return Attachment(
        create_time=created, log_time=logged, name=name, media_type=media_type, data=bytes(data)
    )


def check_index(body: bytes | memoryview) -> None:
    """Refuse what is no index of messages: a chunk that a damaged bit calls one."""
    fields = Fields(body)
    fields.take(2)
    fields.take(fields.number(4))
    fields.end()


def chunk(body: bytes | memoryview) -> bytes:
    """The content of a record of the kind Chunk, its size and checksum compared."""
    fields = Fields(body)
    fields.take(16)  # times of its messages, which are in the messages too
    size, crc = fields.number(8), fields.number(4)
    compression = fields.text()
    data = fields.take(fields.number(8))
    fields.end()
    unpack = _UNPACK.get(compression)
    if size > limits.CHUNK or unpack is None:
        raise DamagedError(f"a chunk of {size} bytes, compression {compression!r}")
    content = unpack(data, size)
    if len(content) != size or zlib.crc32(content) != crc:
        raise DamagedError("a chunk that is not what its checksum says")
    return content


def _lz4(data: memoryview, size: int) -> bytes:
    decompressor = lz4.frame.LZ4FrameDecompressor()
    try:
        content: bytes = decompressor.decompress(data, max_length=size + 1)
    except (RuntimeError, MemoryError) as error:
        raise DamagedError("a chunk that is no lz4 frame") from error
    if not decompressor.eof or decompressor.unused_data:
        raise DamagedError("a chunk that is not one lz4 frame")
    return content


def _zstd(data: memoryview, size: int) -> bytes:
    import zstandard  # for logs that other programs have packed anew

    decompressor = zstandard.ZstdDecompressor(max_window_size=limits.CHUNK)
    try:
        with decompressor.stream_reader(data) as stream:
            return stream.read(size + 1)
    except (zstandard.ZstdError, MemoryError) as error:
        raise DamagedError("a chunk that is no zstd frame") from error


_UNPACK: dict[str, Callable[[memoryview, int], bytes]] = {
    "lz4": _lz4,
    "zstd": _zstd,
    "": lambda data, size: bytes(data[: size + 1]),
}
