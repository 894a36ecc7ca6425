"""The file a log is, held against the mcap library's readers byte for byte."""

from __future__ import annotations

import io
import threading
import zlib
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from log_samples import write_log
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    DataEnd,
    Footer,
    Header,
    Message,
    MessageIndex,
    Metadata,
    Schema,
    SummaryOffset,
)
from mcap.stream_reader import CRCValidationError, StreamReader, get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from dnnmso_mj import __version__
from dnnmso_mj.log.background import Background
from dnnmso_mj.log.messages import HEADER_SIZE, RECORD, Messages, pack, pack_one, unpack
from dnnmso_mj.log.writer import CHUNK_BYTES, LogWriter
from dnnmso_mj.trace import StepLayout


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "run.mcap"
    write_log(path)
    return path


def some_messages(count: int = 7, size: int = 5, channel: int = 3) -> Messages:
    rng = np.random.default_rng(0)
    return Messages(
        channel_id=channel,
        time_ns=np.arange(count, dtype=np.uint64) * 1_000_000 + 2**40,
        sequence=np.arange(count, dtype=np.uint32),
        data=rng.integers(0, 256, (count, size), dtype=np.uint8),
    )


def record_at(data: bytes, place: int) -> tuple[int, ReadDataStream]:
    """Opcode and content of the record at a place of a file."""
    opcode, length = RECORD.unpack_from(data, place)
    start = place + RECORD.size
    return opcode, ReadDataStream(io.BytesIO(data[start : start + length]))


def test_the_library_reads_messages_packed_together_as_single_ones() -> None:
    packed = some_messages()
    data = b"\x89MCAP0\r\n" + pack(packed) + pack_one(4, 2**33, b"alone")
    records = StreamReader(io.BytesIO(data)).records
    found = [next(records) for _ in range(8)]
    assert [m.data for m in found] == [*(row.tobytes() for row in packed.data), b"alone"]
    assert [m.log_time for m in found] == [*packed.time_ns.tolist(), 2**33]
    assert [m.publish_time for m in found] == [m.log_time for m in found]
    assert [m.sequence for m in found] == [*range(7), 0]
    assert [m.channel_id for m in found] == [3] * 7 + [4]


def test_messages_alike_come_back_together_and_others_apart() -> None:
    runs = [some_messages(3), some_messages(2, channel=4), some_messages(1, size=9, channel=4)]
    found = list(unpack(b"".join(map(pack, runs))))
    assert [len(run) for run in found] == [3, 2, 1]
    for run, expected in zip(found, runs, strict=True):
        assert run.channel_id == expected.channel_id
        for name in ("time_ns", "sequence", "data"):
            np.testing.assert_array_equal(getattr(run, name), getattr(expected, name))


def test_a_chunk_that_ends_within_a_record_is_refused() -> None:
    with pytest.raises(ValueError, match="ends behind its chunk"):
        list(unpack(pack(some_messages())[:-1]))


def test_message_indexes_point_at_the_messages(log: Path) -> None:
    data = log.read_bytes()
    summary = make_reader(io.BytesIO(data)).get_summary()
    counts = dict.fromkeys(summary.channels, 0)
    for chunk in summary.chunk_indexes:
        _, stream = record_at(data, chunk.chunk_start_offset)
        content, size = get_chunk_data_stream(Chunk.read(stream), validate_crc=True)
        inside = content.read(size)
        for channel, place in chunk.message_index_offsets.items():
            opcode, stream = record_at(data, place)
            assert opcode == Opcode.MESSAGE_INDEX
            index = MessageIndex.read(stream)
            assert index.channel_id == channel
            counts[channel] += len(index.records)
            for time_ns, offset in index.records:
                (message, *_) = unpack(inside[offset:])
                assert (message.channel_id, message.time_ns[0]) == (channel, time_ns)
        last = max(chunk.message_index_offsets.values())
        end = last + RECORD.size + RECORD.unpack_from(data, last)[1]
        first = chunk.chunk_start_offset + chunk.chunk_length
        assert chunk.message_index_length == end - first
    assert counts == dict(summary.statistics.channel_message_counts)


def test_every_part_of_a_log_has_a_checksum_that_fits(log: Path) -> None:
    data = log.read_bytes()
    records = {type(r): r for r in StreamReader(io.BytesIO(data), validate_crcs=True).records}
    end = data.rindex(RECORD.pack(Opcode.DATA_END, 4), 0, records[Footer].summary_start)
    assert records[DataEnd].data_section_crc == zlib.crc32(data[:end]) != 0
    footer = len(data) - 8 - 4
    assert records[Footer].summary_crc == zlib.crc32(data[records[Footer].summary_start : footer])


@pytest.mark.parametrize("text", [b'"name":"sample"', b"<mujoco", b"numba", b"wall_s"])
def test_a_flipped_bit_beside_the_chunks_is_noticed(log: Path, text: bytes) -> None:
    data = bytearray(log.read_bytes())
    data[data.index(text)] ^= 1
    with pytest.raises((CRCValidationError, McapError)):
        list(StreamReader(io.BytesIO(bytes(data)), validate_crcs=True).records)


@pytest.mark.parametrize(("joints", "dt"), [(2, 1e-5), (6, 1e-3), (40, 1e-3)])
def test_no_chunk_exceeds_64_kib(tmp_path: Path, joints: int, dt: float) -> None:
    path = tmp_path / "run.mcap"
    layout = StepLayout(joints, 4)
    with path.open("wb") as file:
        writer = LogWriter(file)
        channel = writer.add_channel("/step", "protobuf", 0)
        size = 8 * layout.width
        count = min(int(0.05 / dt), CHUNK_BYTES // (HEADER_SIZE + size))
        for _ in range(3):
            writer.add_messages(some_messages(count, size, channel))
            writer.add_messages(some_messages(1, size, channel))
            writer.add_message(channel, 0, bytes(size))
        writer.finish()
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        chunks = reader.get_summary().chunk_indexes
        assert max(chunk.uncompressed_size for chunk in chunks) <= CHUNK_BYTES
        assert len(list(reader.iter_messages())) == 3 * (count + 2)


def test_an_empty_file_is_complete_too(tmp_path: Path) -> None:
    with (tmp_path / "empty.mcap").open("wb") as file:
        LogWriter(file).finish()
    with (tmp_path / "empty.mcap").open("rb") as file:
        found = make_reader(file, validate_crcs=True).get_summary().statistics
    assert (found.message_count, found.message_start_time, found.message_end_time) == (0, 0, 0)


# ---- the thread


def test_giving_work_never_waits_for_a_disk_that_stands_still() -> None:
    gate, done = threading.Event(), []
    background = Background(limit=100)
    background.put(gate.wait, 60)
    for k in range(40):
        background.put(partial(done.append, k), 1)  # none could return if it waited
    assert done == []
    assert background.waited_s == 0.0
    gate.set()
    background.drain()
    assert done == list(range(40))
    background.stop()


def test_work_put_off_is_done_before_the_next_and_not_sooner() -> None:
    done: list[int] = []
    background = Background(limit=100)
    background.put_off(partial(done.append, 1))
    background.put_off(partial(done.append, 2))
    background.drain()
    assert done == []
    background.put(partial(done.append, 3))
    background.drain()
    assert done == [1, 2, 3]
    background.stop()


def test_beyond_its_limit_giving_work_waits_and_counts_the_time() -> None:
    gate, done = threading.Event(), []
    background = Background(limit=100)
    background.put(gate.wait, 60)
    opener = threading.Timer(0.05, gate.set)
    opener.start()
    background.put(partial(done.append, 1), 41)
    assert done == [1]
    assert 0.01 < background.waited_s < 20.0
    background.stop()


def test_the_first_error_ends_the_work_and_is_told_at_every_call() -> None:
    done: list[int] = []
    background = Background(limit=100)

    def fail() -> None:
        raise OSError(28, "No space left on device")

    background.put(fail)
    background.put(partial(done.append, 1))
    for call in (background.drain, lambda: background.put(fail), background.drain):
        with pytest.raises(OSError, match="No space left"):
            call()
    background.stop()
    assert done == []


# ---- the file against itself: every index and figure against the records it is of


def walk(data: bytes, start: int, end: int) -> list[tuple[int, int, int]]:
    """Place, opcode and whole length of each record from one place to another."""
    found = []
    while start < end:
        opcode, length = RECORD.unpack_from(data, start)
        found.append((start, opcode, RECORD.size + length))
        start += RECORD.size + length
    assert start == end
    return found


def parts_of(data: bytes) -> tuple[list[tuple[int, int, int]], Footer]:
    """The records up to the summary, and the footer."""
    footer = Footer.read(record_at(data, len(data) - len(MCAP0_MAGIC) - 20 - RECORD.size)[1])
    return walk(data, len(MCAP0_MAGIC), footer.summary_start), footer


@pytest.fixture
def written() -> bytes:
    """Every kind of record, more than once, with times that do not ascend."""
    file = io.BytesIO()
    writer = LogWriter(file)
    writer.add_metadata("one", {"key": "value"})
    writer.add_attachment(7, "first.bin", "application/x-first", b"123")
    schema = writer.add_schema("Thing", "jsonschema", b"{}")
    channels = [
        writer.add_channel(f"/{name}", "json", id)
        for name, id in zip("ab", (schema, 0), strict=True)
    ]
    other = writer.add_schema("Other", "protobuf", b"other")
    writer.add_channel("/unused", "protobuf", other)
    writer.add_message(channels[0], 500, b"{}")
    writer.add_messages(some_messages(7, 5, channels[1]))
    writer.add_message(channels[0], 400, b'{"x": 1}')
    writer.flush()
    writer.add_message(channels[1], 2**41, bytes(30))
    writer.add_message(channels[1], 2**40, bytes(40))
    writer.add_metadata("two", {})
    writer.add_attachment(9, "second.bin", "text/plain", b"")
    writer.add_message(channels[1], 600, bytes(50))
    writer.finish()
    return file.getvalue()


def test_a_file_begins_with_who_wrote_it(written: bytes) -> None:
    opcode, stream = record_at(written, len(MCAP0_MAGIC))
    header = Header.read(stream)
    assert written.startswith(MCAP0_MAGIC)
    assert written.endswith(MCAP0_MAGIC)
    assert (opcode, header.profile, header.library) == (
        Opcode.HEADER,
        "",
        f"dnnmso_mj {__version__}",
    )


def test_schemas_and_channels_come_back_as_they_were_given(written: bytes) -> None:
    summary = make_reader(io.BytesIO(written)).get_summary()
    schemas = {s.id: (s.name, s.encoding, s.data) for s in summary.schemas.values()}
    assert schemas == {1: ("Thing", "jsonschema", b"{}"), 2: ("Other", "protobuf", b"other")}
    channels = {
        c.id: (c.topic, c.message_encoding, c.schema_id, c.metadata)
        for c in summary.channels.values()
    }
    assert channels == {
        1: ("/a", "json", 1, {}),
        2: ("/b", "json", 0, {}),
        3: ("/unused", "protobuf", 2, {}),
    }


def test_messages_come_back_with_their_times_from_any_reader(written: bytes) -> None:
    found = make_reader(io.BytesIO(written), validate_crcs=True).iter_messages()
    times = [(channel.topic, m.log_time, len(m.data)) for _, channel, m in found]
    packed = [("/b", 2**40 + k * 1_000_000, 5) for k in range(7)]
    expected = [("/a", 400, 8), ("/a", 500, 2), ("/b", 600, 50), *packed]
    expected += [("/b", 2**40, 40), ("/b", 2**41, 30)]
    assert sorted(times) == sorted(expected)


def test_each_index_says_where_and_what_its_record_is(written: bytes) -> None:
    before, _ = parts_of(written)
    summary = make_reader(io.BytesIO(written)).get_summary()
    kinds = {
        Opcode.CHUNK: (
            Chunk,
            [(c.chunk_start_offset, c.chunk_length) for c in summary.chunk_indexes],
        ),
        Opcode.ATTACHMENT: (Attachment, [(a.offset, a.length) for a in summary.attachment_indexes]),
        Opcode.METADATA: (Metadata, [(m.offset, m.length) for m in summary.metadata_indexes]),
    }
    records = {}
    for opcode, (kind, places) in kinds.items():
        assert places == [(place, size) for place, found, size in before if found == opcode]
        records[opcode] = [kind.read(record_at(written, place)[1]) for place, _ in places]
        assert len(places) == 2
    for index, chunk in zip(summary.chunk_indexes, records[Opcode.CHUNK], strict=True):
        assert (index.compression, index.compressed_size) == ("lz4", len(chunk.data))
        assert index.uncompressed_size == chunk.uncompressed_size
        span = chunk.message_start_time, chunk.message_end_time
        assert span == (index.message_start_time, index.message_end_time)
    assert [c.message_start_time for c in summary.chunk_indexes] == [400, 600]
    assert [c.message_end_time for c in summary.chunk_indexes] == [2**40 + 6_000_000, 2**41]
    for index, attached in zip(summary.attachment_indexes, records[Opcode.ATTACHMENT], strict=True):
        assert (index.name, index.media_type) == (attached.name, attached.media_type)
        assert (index.log_time, index.create_time) == (attached.log_time, attached.create_time)
        assert index.data_size == len(attached.data)
    attachments = [(a.name, a.media_type, a.log_time, a.data) for a in records[Opcode.ATTACHMENT]]
    assert attachments == [
        ("first.bin", "application/x-first", 7, b"123"),
        ("second.bin", "text/plain", 9, b""),
    ]
    assert {a.create_time - a.log_time for a in records[Opcode.ATTACHMENT]} == {0}
    assert [m.name for m in summary.metadata_indexes] == ["one", "two"]
    assert [m.metadata for m in records[Opcode.METADATA]] == [{"key": "value"}, {}]


def test_statistics_count_what_is_in_the_file(written: bytes) -> None:
    found = make_reader(io.BytesIO(written)).get_summary().statistics
    assert (found.schema_count, found.channel_count) == (2, 3)
    assert (found.chunk_count, found.attachment_count, found.metadata_count) == (2, 2, 2)
    assert (found.message_count, found.channel_message_counts) == (12, {1: 2, 2: 10})
    assert (found.message_start_time, found.message_end_time) == (400, 2**41)


def test_the_summary_says_where_each_group_of_it_is(written: bytes) -> None:
    before, footer = parts_of(written)
    assert before[-1][1] == Opcode.DATA_END
    end = len(written) - len(MCAP0_MAGIC) - 20 - RECORD.size
    groups: dict[int, list[int]] = {}
    for place, opcode, size in walk(written, footer.summary_start, footer.summary_offset_start):
        start, length = groups.get(opcode, (place, 0))
        assert start + length == place  # a group's records stand together
        groups[opcode] = [start, length + size]
    offsets = walk(written, footer.summary_offset_start, end)
    read = [SummaryOffset.read(record_at(written, place)[1]) for place, _, _ in offsets]
    assert {o.group_opcode: [o.group_start, o.group_length] for o in read} == groups
    assert list(groups) == [
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.STATISTICS,
        Opcode.CHUNK_INDEX,
        Opcode.ATTACHMENT_INDEX,
        Opcode.METADATA_INDEX,
    ]


@pytest.mark.parametrize(("size", "chunks"), [(100, [64 * 1024]), (101, [65405, 132])])
def test_a_chunk_is_ended_only_before_a_message_that_does_not_fit(
    size: int, chunks: list[int]
) -> None:
    file = io.BytesIO()
    writer = LogWriter(file)
    channel = writer.add_channel("/a", "json", 0)
    begun = len(file.getvalue())
    writer.add_message(channel, 0, bytes(64 * 1024 - len(channel_record(channel)) - 162))
    writer.add_message(channel, 0, bytes(size))
    assert (len(file.getvalue()) > begun) == (len(chunks) > 1)
    writer.flush()
    writer.add_message(channel, 0, b"")
    writer.finish()
    found = make_reader(io.BytesIO(file.getvalue())).get_summary().chunk_indexes
    assert [chunk.uncompressed_size for chunk in found] == [*chunks, HEADER_SIZE]


def test_a_chunk_of_messages_packed_together_spans_their_times() -> None:
    file = io.BytesIO()
    writer = LogWriter(file)
    writer.add_messages(some_messages(3, 5, writer.add_channel("/a", "json", 0)))
    writer.finish()
    summary = make_reader(io.BytesIO(file.getvalue())).get_summary()
    (chunk,), statistics = summary.chunk_indexes, summary.statistics
    for found in (chunk, statistics):
        assert (found.message_start_time, found.message_end_time) == (2**40, 2**40 + 2_000_000)


def channel_record(channel: int) -> bytes:
    builder = RecordBuilder()
    Channel(channel, "/a", "json", {}, 0).write(builder)
    return builder.end()


class Watched(io.BytesIO):
    """A file that counts how often it was handed to the operating system."""

    flushed = 0

    def flush(self) -> None:
        self.flushed = len(self.getvalue())


def test_flush_and_finish_hand_all_to_the_operating_system() -> None:
    file = Watched()
    writer = LogWriter(file)
    channel = writer.add_channel("/a", "json", 0)
    writer.add_message(channel, 0, b"{}")
    assert file.flushed == 0
    writer.flush()
    assert file.flushed == len(file.getvalue()) > 100
    writer.finish()
    assert file.flushed == len(file.getvalue())
    writer = LogWriter(empty := Watched())
    writer.add_channel("/a", "json", 0)
    writer.flush()
    assert len(empty.getvalue()) == empty.flushed < 60  # a channel waits for its first message


def test_what_stands_before_the_summary_can_be_read_alone(written: bytes) -> None:
    """As of a torn log: each message's channel and schema go before it."""
    records = list(StreamReader(io.BytesIO(written), validate_crcs=True).records)
    torn = records[: next(k for k, r in enumerate(records) if isinstance(r, DataEnd))]
    schemas = {r.id: r.name for r in torn if isinstance(r, Schema)}
    channels = {r.id: r.topic for r in torn if isinstance(r, Channel)}
    assert schemas == {1: "Thing", 2: "Other"}
    assert channels == {1: "/a", 2: "/b", 3: "/unused"}
    first = next(k for k, r in enumerate(torn) if isinstance(r, Message))
    assert sum(isinstance(r, Schema | Channel) for r in torn[:first]) == 5
    assert sum(isinstance(r, Message) for r in torn) == 12
