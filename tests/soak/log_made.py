"""Logs that nobody's run wrote: whole by their checksums, and made to hurt whoever reads them."""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Attachment, Chunk, McapRecord

from dnnmso_mj.log.format import EVENTS, STEP, event_message, scenario_record
from dnnmso_mj.log.messages import Messages, pack, pack_one
from dnnmso_mj.log.segments import SEGMENTS
from dnnmso_mj.log.step_message import StepFormat
from dnnmso_mj.log.writer import LogWriter
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.trace import Event, StepLayout
from soak.log_damage import records

Array = np.ndarray
Fill = Callable[[LogWriter], None]

LAYOUT = StepLayout(n_joints=2, n_layers=4)
GIANT = 1 << 60
MB = 1_000_000


def scenario() -> Scenario:
    """That the logs say they are of."""
    return Scenario.model_validate({
        "name": "made",
        "reference": {"kind": "sinusoid"},
        "controller": {"kind": "dnn_mso", "observer": {"K2": 10.0}},
    })  # fmt: skip


def steps(count: int, layout: StepLayout = LAYOUT) -> Array:
    """Messages of ticks in their order, all else zero."""
    rows = np.zeros((count, layout.width))
    rows[:, 0] = np.arange(count) * 1e-3
    return StepFormat(layout).encode(rows)


def write(path: Path, fill: Fill, text: str | None = None, topic: str = STEP.name) -> None:
    """A complete log: a scenario, a channel of steps, and what `fill` puts in."""
    with path.open("wb") as file:
        writer = LogWriter(file)
        record = scenario_record(scenario())
        writer.add_metadata("scenario", record if text is None else record | {"json": text})
        schema = writer.add_schema(STEP.schema_name, "protobuf", STEP.schema)
        writer.add_channel(topic, "protobuf", schema)
        events = writer.add_schema(EVENTS.schema_name, "protobuf", EVENTS.schema)
        writer.add_channel(EVENTS.name, "protobuf", events)
        fill(writer)
        writer.finish()


def give(data: Array, numbers: Array | None = None, times: Array | None = None) -> Fill:
    """Steps with numbers and times of our choice."""
    order = np.arange(len(data))
    numbers = order if numbers is None else np.asarray(numbers)
    times = (order * 1_000_000 if times is None else np.asarray(times)).astype(np.uint64)

    def fill(writer: LogWriter) -> None:
        writer.add_messages(Messages(1, times, numbers.astype(np.uint32), data))

    return fill


def _bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def spliced(path: Path, more: bytes, behind: int = 0) -> None:
    """Put records before the end of a log's data, and make its checksums right again."""
    data = path.read_bytes()
    kinds = records(data)
    end = next(start for kind, start, _ in kinds if kind == 15)
    body = data[:end] + more
    closing = struct.pack("<BQI", 15, 4, zlib.crc32(body))
    footer = struct.pack("<BQQQ", 2, 20, 0, 0)
    closing += footer + struct.pack("<I", zlib.crc32(footer)) + data[:8]
    path.write_bytes(body + closing + bytes(behind))


def chunk(content: bytes, *, claims: int | None = None, how: str = "lz4") -> bytes:
    """A chunk's record, whose size may be claimed to be another."""
    packers = {"lz4": lz4.frame.compress, "zstd": zstandard.compress, "": bytes}
    size = len(content) if claims is None else claims
    return _bytes(Chunk(how, packers[how](content), 0, 0, zlib.crc32(content), size))


def flood(kinds: int) -> bytes:
    """Messages of a few bytes, each unlike the one before."""
    pair = b"".join(pack_one(2, 0, bytes(k)) for k in range(kinds))
    return pair * (12 * MB // len(pair))


def npz(**members: bytes) -> bytes:
    """A deflated archive of these members."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return data.getvalue()


def stored(name: str, content: bytes) -> bytes:
    """An archive of one member as it is."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr(name, content)
    return data.getvalue()


def header(shape: str, descr: str = "'<f8'") -> bytes:
    """An npy with a header of our choice, and eight bytes of data."""
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}"
    text = text + " " * (-(10 + len(text) + 1) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode() + bytes(8)


def pickled() -> bytes:
    """An array of Python objects."""
    data = io.BytesIO()
    np.save(data, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    return data.getvalue()


def overlapping() -> bytes:
    """Members that share their bytes: the directory names one of them often."""
    one = stored("a.npy", header("(1,)") + bytes(MB))
    directory = one.index(b"PK\x01\x02")
    entry, end = one[directory:-22], bytearray(one[-22:])
    count = 2000
    struct.pack_into("<HHL", end, 8, count, count, count * len(entry))
    return one[:directory] + entry * count + bytes(end)


def with_snapshot(data: bytes, name: str = "snapshot/controller/0.0.npz") -> Fill:
    """Some ticks, and an attachment."""

    def fill(writer: LogWriter) -> None:
        give(steps(50))(writer)
        writer.flush()
        writer.add_attachment(0, name, "application/zip", data)

    return fill


def with_metadata(name: str, record: Mapping[str, str]) -> Fill:
    """Some ticks, and a metadata record."""

    def fill(writer: LogWriter) -> None:
        give(steps(50))(writer)
        writer.add_metadata(name, dict(record))

    return fill


def events(count: int, text: str, t: float = 0.0) -> Fill:
    """Some ticks, and many events."""

    def fill(writer: LogWriter) -> None:
        give(steps(50))(writer)
        data = np.frombuffer(event_message(Event(t, "info", text)), np.uint8)
        block = np.tile(data, (max(1, min(count, 10 * MB // len(data))), 1))
        for _ in range(max(1, count // len(block))):
            zero = np.zeros(len(block), np.uint64)
            writer.add_messages(Messages(2, zero, zero.astype(np.uint32), block))

    return fill


def _filled(fill: Fill, text: str | None = None) -> Callable[[Path], None]:
    return lambda path: write(path, fill, text)


def _spliced(*more: bytes) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        write(path, give(steps(50)))
        spliced(path, b"".join(more))

    return make


def _numbers() -> dict[str, Callable[[Path], None]]:
    """Ticks that are missing, doubled, in another order, or of no time that can be."""
    some, order = steps(400), np.arange(400)
    gap = np.delete(order, slice(100, 150))
    rows = np.zeros((50, LAYOUT.width))
    absurd = {}
    for t in (np.nan, np.inf, -np.inf, 1e300, -1.0):
        rows[:, 0] = t
        absurd[f"every tick of t = {t}"] = _filled(give(StepFormat(LAYOUT).encode(rows.copy())))
        numbers = np.zeros(50)
        unnumbered = give(StepFormat(LAYOUT).encode(rows.copy()), numbers)
        absurd[f"every tick of t = {t}, unnumbered"] = _filled(unnumbered)
    zeros = np.zeros(350)
    return absurd | {
        "numbered ticks with a gap": _filled(give(some[gap], gap)),
        "ticks in another order": _filled(give(some[::-1], order[::-1])),
        "a doubled tick": _filled(give(some[np.maximum(order, 1)], np.maximum(order, 1) - 1)),
        "unnumbered ticks with a gap": _filled(give(some[gap], zeros)),
        "unnumbered ticks backwards": _filled(give(some[::-1], np.zeros(400))),
        "times of the far future": _filled(give(some, times=np.full(400, (1 << 64) - 1))),
    }


def _chunks() -> dict[str, Callable[[Path], None]]:
    same = pack(Messages(1, np.zeros(20_000), np.arange(50, 20_050), steps(20_000)))
    many = b"".join(
        chunk(pack(Messages(1, np.zeros(20_000), np.arange(20_000) + 50 + 20_000 * k, part)))
        for k, part in enumerate([np.broadcast_to(steps(1), (20_000, steps(1).shape[1]))] * 20)
    )
    return {
        "a chunk that claims 2^60 bytes": _spliced(chunk(b"", claims=GIANT)),
        "a chunk that holds more than it claims": _spliced(chunk(bytes(200 * MB), claims=100)),
        "a chunk of 200 MB of zeros": _spliced(chunk(bytes(200 * MB))),
        "zeros in zstd": _spliced(
            chunk(bytes(200 * MB), how="zstd"), chunk(bytes(9), claims=GIANT)
        ),
        "an unknown compression": _spliced(chunk(b"").replace(b"lz4", b"xyz")),
        "ticks that compress well": _spliced(chunk(same)),
        "many chunks that compress 100 times": _spliced(many),
        "many chunks of zstd": _spliced(*[chunk(flood(2)[: 10 * MB], how="zstd")] * 400),
        "messages that alternate": _spliced(*[chunk(flood(2))] * 8),
        "messages of many sizes": _spliced(*[chunk(flood(40))] * 8),
        "chunks in a chunk": _spliced(chunk(chunk(chunk(same)))),
        "a giant string": _spliced(struct.pack("<BQI", 12, 24, 0xFFFFFFFF) + bytes(20)),
        "a giant record": _spliced(struct.pack("<BQ", 12, GIANT)),
        "a giant attachment": _spliced(
            struct.pack("<BQQQIIQ", 9, 36, 0, 0, 0, 0, GIANT) + bytes(4)
        ),
        "channels without end": _spliced(
            *[chunk(struct.pack("<BQHHIII", 4, 16, k, 0, 0, 0, 0) * 1000) for k in range(3, 1000)]
        ),
    }


def _metadata() -> dict[str, Callable[[Path], None]]:
    good = json.loads(scenario().model_dump_json())
    deep = "[" * 100_000
    flat = json.dumps(good | {"description": "a" * 10 * MB})
    many = '{"name": [' + "[]," * 3 * MB + "[]]}"
    wrong = {key: [[{}]] for key in good}
    metrics = ["[1]", '"a"', "{}", "NaN", "Infinity", deep, "1" * 100_000, "", "\x00", "1e999"]
    runs = [{"seed": "x"}, {"wall_s": "nan"}, {"seed": "1" * 5000}, {"status": "\x1b[2J"}]
    parts = [[], [{"first": "x"}], [1], {"a": 1}, [{"first": 5}], None]
    return {
        "a scenario of 10 MB": _filled(give(steps(50)), flat),
        "a scenario of many lists": _filled(give(steps(50)), many),
        "a deep scenario": _filled(give(steps(50)), deep),
        "a scenario of wrong types": _filled(give(steps(50)), json.dumps(wrong)),
        "a scenario of three joints": _filled(
            give(steps(50, StepLayout(n_joints=3, n_layers=4))), json.dumps(good)
        ),
        **{f"a metric {m[:9]!r}": _filled(with_metadata("metrics", {"rmse": m})) for m in metrics},
        **{f"a run {str(r)[:20]}": _filled(with_metadata("run", r)) for r in runs},
        **{
            f"segments {str(p)[:20]}": _filled(with_metadata(SEGMENTS, {"json": json.dumps(p)}))
            for p in parts
        },
        "deep segments": _filled(with_metadata(SEGMENTS, {"json": deep})),
        "metadata without end": _filled(with_metadata("notes", {f"{k:x}": "" for k in range(MB)})),
    }


def _attachments() -> dict[str, Callable[[Path], None]]:
    zeros = header("(8,)") + bytes(100 * MB)
    data = {
        "npz of 100 MB of zeros": npz(W=zeros),
        "npz of Python objects": stored("W.npy", pickled()),
        "npz of a giant shape": stored("W.npy", header("(1000000000000,)")),
        "npz of a negative shape": stored("W.npy", header("(-1,)")),
        "npz of nothing often": stored("W.npy", header("(10000000000,)", "'V0'")),
        "npz of giant items": stored("W.npy", header("(1,)", "'V1000000000'")),
        "npz of a deep header": stored("W.npy", header("(" * 900)),
        "npz of no array": stored("W.txt", b"x"),
        "npz of shared bytes": overlapping(),
        "npz of a long directory": npz(**{f"{k:x}": b"" for k in range(20_000)}),
    }
    names = ["nan", "inf", "-1.0", "1e+308", "0.0/../../x", "\x00"]
    made = {name: _filled(with_snapshot(content)) for name, content in data.items()}
    return made | {
        f"a snapshot of {t!r}": _filled(with_snapshot(b"x", f"snapshot/world/{t}.npz"))
        for t in names
    }


def _messages() -> dict[str, Callable[[Path], None]]:
    layout = StepLayout(n_joints=2, n_layers=4)
    odd = np.concatenate([steps(30_000, layout)[:, 9:], steps(30_000, layout)[:, :9]], axis=1)
    wide = b"\x12" + b"\xff\xff\xff\x07" + bytes(0x7FFFFF)
    giant = np.frombuffer(b"\x12\x80\x80\x80\x04" + bytes(8 << 20), np.uint8)[None]
    return {
        "laid out by another program": _filled(give(odd)),
        "a million joints": _filled(give(giant)),
        "a step that ends early": _filled(give(np.frombuffer(wide[:5000], np.uint8)[None])),
        "events without end": _filled(events(3 * MB, "a")),
        "a giant event": _filled(events(20, "a" * 8 * MB)),
        "an event of the far future": _filled(events(3, "a", 9e12)),
        "no such topic": lambda path: write(path, give(steps(9)), topic="/other"),
    }


def makers() -> dict[str, Callable[[Path], None]]:
    """What writes each of these logs to a path."""
    return {**_numbers(), **_chunks(), **_metadata(), **_attachments(), **_messages()}


__all__ = ["Attachment", "makers"]
