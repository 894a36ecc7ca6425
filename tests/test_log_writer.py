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
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk, DataEnd, Footer, MessageIndex
from mcap.stream_reader import CRCValidationError, StreamReader, get_chunk_data_stream

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
        assert make_reader(file, validate_crcs=True).get_summary().statistics.message_count == 0


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
