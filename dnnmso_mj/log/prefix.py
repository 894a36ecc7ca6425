"""The readable part of an MCAP file, whether complete, torn or damaged."""

# mypy: untyped-calls-exclude=mcap
from __future__ import annotations

import mmap
import stat
from collections.abc import Iterator
from pathlib import Path

from mcap.records import Attachment, Channel, DataEnd, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, Writer

from dnnmso_mj.errors import LogError


class Prefix:
    """The records of an MCAP file up to its end, or up to where it is torn or damaged.

    `complete` says, after a pass, whether that was the end.

    Args:
        path: the file.

    Raises:
        LogError: it is missing, unreadable, not a regular file, empty or something else.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = _size_of_mcap(path)
        self.complete = False

    def __iter__(self) -> Iterator[McapRecord]:
        with (
            self.path.open("rb") as file,
            mmap.mmap(file.fileno(), self.size, access=mmap.ACCESS_READ) as data,
        ):
            # A damaged length must not make the reader ask for more memory than the file has.
            reader = StreamReader(data, validate_crcs=True, record_size_limit=self.size)  # type: ignore[arg-type]
            records = iter(reader.records)
            while True:
                try:
                    record = next(records)
                except StopIteration:
                    self.complete = True
                    return
                except Exception:  # the library lets through whatever damaged bytes provoke
                    return
                yield record


def copy(prefix: Prefix, writer: Writer, leave_out: str | None = None) -> None:
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
                schemas[record.id] = writer.register_schema(
                    record.name, record.encoding, record.data
                )
            case Channel() if record.id not in channels:
                schema = schemas.get(record.schema_id, 0)  # 0: none
                channels[record.id] = writer.register_channel(
                    record.topic, record.message_encoding, schema, record.metadata
                )
            case Message() if record.channel_id in channels:
                channel, time = channels[record.channel_id], record.log_time
                writer.add_message(channel, time, record.data, record.publish_time, record.sequence)
            case Metadata() if record.name != leave_out:
                writer.add_metadata(record.name, record.metadata)
            case Attachment(created, time, name, media_type, data):
                writer.add_attachment(created, time, name, media_type, data)


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
