"""Logs come back as they were written; torn and damaged ones as far as they go."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_samples import LAYOUT, METRICS, append_all, recorder, rows, scenario, write_log
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from test_recording import full_disk
from test_step_message import as_message

from dnnmso_mj.errors import LogError
from dnnmso_mj.log.format import STEP
from dnnmso_mj.log.step_message import StepFormat
from dnnmso_mj.reading import log_info, read_snapshots, read_trace, recover
from dnnmso_mj.trace import FLAGS, SCALARS, Event, RunInfo

COUNT = 230
ONE_STEP = StepFormat(LAYOUT).encode(rows(1)).tobytes()


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "run.mcap"
    write_log(path, COUNT)
    return path


@pytest.fixture
def torn(log: Path, tmp_path: Path) -> Path:
    """The log as a kill at four fifths of it leaves it."""
    path = tmp_path / "torn.mcap"
    data = log.read_bytes()
    path.write_bytes(data[: len(data) * 4 // 5])
    return path


def refusal(read: Callable[[Path], object], path: Path) -> str | None:
    """The message with which a file is refused, if it is; any other error passes."""
    try:
        read(path)
    except LogError as error:
        return str(error)
    return None


def assert_prefix(path: Path, least: int = 1) -> int:
    """The trace of a torn log is a prefix of the whole one's; returns its length."""
    trace, data = read_trace(path), rows(COUNT)
    assert least <= len(trace) <= COUNT
    for name, column in LAYOUT.columns(data[: len(trace)]).items():
        np.testing.assert_array_equal(trace[name], column)
    return len(trace)


def test_a_log_comes_back_as_it_was_written(log):
    trace = read_trace(log)
    expected = LAYOUT.columns(rows(COUNT))
    assert list(trace) == list(expected)
    for name, column in expected.items():
        assert (trace[name].shape, trace[name].dtype) == (column.shape, column.dtype)
        np.testing.assert_array_equal(trace[name], column)
    assert all(trace[name].shape == (COUNT,) for name in SCALARS)
    assert all(trace[name].dtype == bool for name in FLAGS)
    assert trace.scenario == scenario()
    assert trace.events == (Event(0.1, "warning", "torque limit reached"),)
    assert (trace.info.status, trace.info.seed, trace.info.wall_s) == ("ok", 7, 0.25)
    assert trace.info.metrics == METRICS
    assert trace.info.versions["python"]


@pytest.mark.parametrize("t", [1e-9, 0.1, 1.234, 123.456, 99_999.999])
def test_times_of_events_come_back_exactly(tmp_path, t):
    events = tuple(Event(t, level, f"a {level}") for level in ("info", "warning", "error"))
    with recorder(tmp_path / "run.mcap") as open_log:
        open_log.append(rows(1))
        for event in events:
            open_log.event(event)
        open_log.finish(RunInfo(status="ok", seed=7))
    assert read_trace(tmp_path / "run.mcap").events == events


def test_info_tells_what_a_log_holds(log):
    info = log_info(str(log))
    assert (info.path, info.size, info.complete) == (log, log.stat().st_size, True)
    assert (info.status, info.seed, info.scenario) == ("ok", 7, "sample")
    assert (info.ticks, info.duration, info.wall_s) == (COUNT, COUNT * 1e-3, 0.25)
    assert info.channels == {
        "/step": COUNT,
        "/tf": 23,
        "/robot_description": 1,
        "/scene": 1,
        "/events": 1,
    }
    assert info.metrics == METRICS
    assert list(info.attachments) == [
        "model.xml",
        "snapshot/controller/0.0.npz",
        "snapshot/controller/0.2.npz",
    ]
    assert [event.message for event in info.events] == ["torque limit reached"]


def test_a_log_torn_anywhere_gives_its_prefix_or_one_message(log, tmp_path):
    data, path, lengths = log.read_bytes(), tmp_path / "torn.mcap", []
    cuts = np.linspace(1, len(data) - 1, 60).astype(int).tolist()
    for cut in cuts:
        path.write_bytes(data[:cut])
        if message := refusal(read_trace, path):
            assert not lengths  # only what comes before the first block has no tick
            assert str(path) in message
        else:
            lengths.append(assert_prefix(path))
            assert read_trace(path).info.status == "unfinished"
            assert not log_info(path).complete
    assert lengths == sorted(lengths)
    assert set(lengths) == {*range(30, COUNT, 30), COUNT}


def test_a_torn_log_still_says_what_it_is(torn):
    info = log_info(torn)
    assert (info.complete, info.status, info.scenario, info.seed) == (
        False,
        "unfinished",
        "sample",
        7,
    )
    assert info.versions["mujoco"]
    assert "model.xml" in info.attachments
    assert info.duration == info.ticks * 1e-3 > 0
    assert [s.t for s in read_snapshots(torn)] == [0.0]


@settings(max_examples=100, deadline=None)
@given(place=st.floats(0, 1, exclude_max=True), bits=st.integers(1, 255), count=st.integers(1, 9))
def test_a_damaged_log_gives_its_prefix_or_one_message(tmp_path_factory, log, place, bits, count):
    data = bytearray(log.read_bytes())
    start = int(place * len(data))
    data[start : start + count] = bytes(byte ^ bits for byte in data[start : start + count])
    path = tmp_path_factory.mktemp("damaged") / "run.mcap"
    path.write_bytes(data)
    for read in (log_info, read_snapshots, lambda path: recover(path, path.with_name("out"))):
        assert str(path) in (refusal(read, path) or str(path))
    message = refusal(read_trace, path)
    assert str(path) in message if message else assert_prefix(path)


def test_a_log_changed_beside_its_chunks_is_not_taken_for_whole(log, tmp_path):
    data, path = log.read_bytes(), tmp_path / "changed.mcap"
    path.write_bytes(data.replace(b"0.25", b"0.52", 1))
    assert log_info(log).complete
    info = log_info(path)
    assert (info.complete, info.status, info.wall_s) == (False, "unfinished", 0.52)


def mcap(path: Path, fill: Callable[[Writer], object]) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        fill(writer)
        writer.finish()
    return path


def with_scenario(writer: Writer, text: str | None = None) -> None:
    writer.add_metadata("scenario", {"json": text or scenario().model_dump_json()})
    writer.add_metadata("versions", {"dnnmso_mj": "9.8"})


def with_step(
    writer: Writer,
    name: str = STEP.schema_name,
    schema: bytes = STEP.schema,
    data: bytes = ONE_STEP,
) -> None:
    with_scenario(writer)
    schema_id = writer.register_schema(name, "protobuf", schema)
    channel = writer.register_channel("/step", "protobuf", schema_id)
    writer.add_message(channel, 0, data, 0)


REFUSALS: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (lambda path: None, "no such log, and none in logs; allowed: a log file"),
    "directory": (Path.mkdir, "is a directory; allowed: an MCAP file"),
    "fifo": (os.mkfifo, "is not a regular file"),
    "empty": (Path.touch, "is empty; expected an MCAP file"),
    "text": (lambda path: path.write_text("t,q\n0,1\n"), "begins with b't,q"),
    "magic alone": (
        lambda path: path.write_bytes(b"\x89MCAP0\r\n"),
        "no metadata record 'scenario': an MCAP of another program",
    ),
    "another program's": (
        lambda path: mcap(path, lambda writer: writer.add_metadata("m", {})),
        "no metadata record 'scenario': an MCAP of another program",
    ),
    "no /step": (lambda path: mcap(path, with_scenario), "no channel /step; its channels: none"),
    "another schema": (
        lambda path: mcap(path, lambda writer: with_step(writer, "foxglove.Log")),
        r"channel /step has foxglove\.Log \(protobuf\); expected dnnmso\.Step",
    ),
    "other fields": (
        lambda path: mcap(path, lambda writer: with_step(writer, schema=b"")),
        r"fields of dnnmso\.Step differ .* Read it with dnnmso_mj 9\.8",
    ),
    "a message that is none": (
        lambda path: mcap(path, lambda writer: with_step(writer, data=b"\xff")),
        r"/step: message 0 is no dnnmso\.Step",
    ),
    "an empty message": (
        lambda path: mcap(path, lambda writer: with_step(writer, data=b"")),
        "/step: message 0 has no joint angle in q",
    ),
    "another version's scenario": (
        lambda path: mcap(
            path, lambda writer: (with_step(writer), with_scenario(writer, '{"name": 3}'))
        ),
        r"its scenario is not one of this version: name: .* Read it with dnnmso_mj 9\.8",
    ),
    "no tick": (lambda path: append_all(path, rows(0)), "holds no tick"),
    "a damaged record": (
        lambda path: mcap(
            path, lambda writer: (with_step(writer), writer.add_metadata("run", {"seed": "x"}))
        ),
        "a metadata record is damaged: invalid literal",
    ),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_what_is_no_log_is_refused_with_one_message(tmp_path, case, monkeypatch):
    make, message = REFUSALS[case]
    monkeypatch.chdir(tmp_path)  # where no other logs are
    path = tmp_path / "run.mcap"
    make(path)
    with pytest.raises(LogError, match=message) as refusal:
        read_trace(path)
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("case", [c for c in REFUSALS if "message" not in c and c != "no tick"])
def test_recover_refuses_what_is_no_log_and_leaves_nothing(tmp_path, case, monkeypatch):
    make, message = REFUSALS[case]
    monkeypatch.chdir(tmp_path)
    make(tmp_path / "run.mcap")
    with pytest.raises(LogError, match=message):
        recover(tmp_path / "run.mcap", tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


def test_an_unfinished_log_without_a_tick_still_has_its_info(tmp_path):
    append_all(tmp_path / "run.mcap", rows(0), RunInfo(status="interrupted", seed=7))
    info = log_info(tmp_path / "run.mcap")
    assert (info.ticks, info.duration, info.status) == (0, 0.0, "interrupted")


def test_steps_of_another_protobuf_writer_are_read(tmp_path):
    data = rows(5)
    data[:, LAYOUT.slices["tau"]] = 0.0

    def fill(writer: Writer) -> None:
        with_scenario(writer)
        schema = writer.register_schema(STEP.schema_name, "protobuf", STEP.schema)
        channel = writer.register_channel("/step", "protobuf", schema)
        for k, row in enumerate(data):
            writer.add_message(channel, k, as_message(row, LAYOUT).SerializeToString(), k)

    trace = read_trace(mcap(tmp_path / "run.mcap", fill))
    for name, column in LAYOUT.columns(data).items():
        np.testing.assert_array_equal(trace[name], column)


def contents(path: Path) -> tuple[list, list, list]:
    """Messages with their topics and schemas, metadata and attachments, by the official reader."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_summary().chunk_indexes
        messages = [
            (schema.name, schema.data, channel.topic, m.log_time, m.sequence, m.data)
            for schema, channel, m in reader.iter_messages(log_time_order=False)
        ]
        return messages, list(reader.iter_metadata()), list(reader.iter_attachments())


def test_recover_makes_a_complete_log_of_a_torn_one(torn, log, tmp_path):
    out = tmp_path / "deep" / "recovered.mcap"
    info = recover(torn, out)
    assert (info.complete, info.status, info.seed) == (True, "unfinished", 7)
    assert info.ticks == log_info(torn).ticks == assert_prefix(out) > 0
    messages, metadata, attachments = contents(out)
    all_messages, all_metadata, all_attachments = contents(log)
    assert messages == all_messages[: len(messages)]
    assert {m[2] for m in messages} == {"/step", "/tf", "/robot_description", "/scene"}
    assert {m.name for m in metadata} >= {"scenario", "versions"}
    assert all(m in all_metadata for m in metadata)
    assert attachments == all_attachments[:2]
    assert set(info.channels) == set(log_info(log).channels)


def test_recovering_a_log_torn_in_its_index_keeps_every_tick(log, tmp_path):
    torn, out = tmp_path / "torn.mcap", tmp_path / "out.mcap"
    torn.write_bytes(log.read_bytes()[:-20])
    info = recover(torn, out)
    assert (info.complete, info.status, info.ticks) == (True, "unfinished", COUNT)
    assert info.metrics == METRICS
    assert [s.t for s in read_snapshots(out)] == [0.0, 0.2]


def test_recovering_a_complete_log_copies_it(log, tmp_path):
    info = recover(log, tmp_path / "copy.mcap")
    assert (info.complete, info.status, info.ticks) == (True, "ok", COUNT)
    assert contents(tmp_path / "copy.mcap") == contents(log)


def test_recover_refuses_an_existing_file(torn, tmp_path):
    out = tmp_path / "out.mcap"
    out.write_text("precious")
    with pytest.raises(LogError, match=r"out\.mcap exists already"):
        recover(torn, out)
    assert out.read_text() == "precious"
    with pytest.raises(LogError, match=r"torn\.mcap exists already"):
        recover(torn, torn)
    assert_prefix(torn)


def test_recover_leaves_nothing_on_a_full_disk(torn, tmp_path):
    out = tmp_path / "out.mcap"
    with full_disk(20_000), pytest.raises(LogError, match=r"out\.mcap cannot be written: File"):
        recover(torn, out)
    assert not out.exists()


def test_a_damaged_snapshot_is_named(tmp_path):
    def fill(writer: Writer) -> None:
        writer.add_attachment(0, 0, "snapshot/net/0.5.npz", "application/zip", b"no zip")
        writer.add_attachment(0, 0, "notes.npz", "application/zip", b"not ours")

    path = mcap(tmp_path / "run.mcap", fill)
    with pytest.raises(LogError, match=r"attachment snapshot/net/0\.5\.npz is no npz file of"):
        read_snapshots(path)


def test_snapshots_never_unpickle(tmp_path):
    data = io.BytesIO()
    np.savez(data, W=np.array([{"a": 1}], dtype=object))
    path = mcap(
        tmp_path / "run.mcap",
        lambda writer: writer.add_attachment(0, 0, "snapshot/net/0.5.npz", "", data.getvalue()),
    )
    with pytest.raises(LogError, match="is no npz file of plain arrays"):
        read_snapshots(path)


def test_rerun_reads_every_tick_the_robot_and_its_frames(log):
    chunk = pytest.importorskip("rerun.chunk", reason="the extra `viewer` is not installed")
    columns: dict[str, dict[str, list]] = {}
    for part in chunk.McapReader(log, timeline_type="duration_ns").stream():
        batch = part.to_record_batch()
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            values = columns.setdefault(part.entity_path, {}).setdefault(name, [])
            values += [value for value in column.to_pylist() if value is not None]
    step = columns["/step"]["dnnmso.Step:message"]
    data = rows(COUNT)
    assert len(step) == COUNT
    assert [message[0]["q"] for message in step] == data[:, LAYOUT.slices["q"]].tolist()
    shapes = {
        path.rsplit("/", 1)[1]: values["CoordinateFrame:frame"]
        for path, values in columns.items()
        if path.startswith("/robot/visual_geometries/")
    }
    assert shapes["base"] == [["world"]]
    assert shapes["rod1"] == shapes["mass1"] == [["link1"]]
    assert shapes["rod2"] == shapes["mass2"] == [["link2"]]
    frames = columns["/tf"]
    edges = zip(frames["Transform3D:parent_frame"], frames["Transform3D:child_frame"], strict=True)
    found = [(parent, child) for (parent,), (child,) in edges]
    assert found.count(("world", "link1")) == found.count(("link1", "link2")) == 23
    assert columns["/events"]["TextLog:text"] == [["torque limit reached"]]


def test_reading_needs_no_simulator():
    program = "import sys, dnnmso_mj.reading; sys.exit('mujoco' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


def test_the_records_are_standard_mcap_to_the_last_crc(log):
    with log.open("rb") as file:
        kinds = {type(record).__name__ for record in StreamReader(file, validate_crcs=True).records}
    assert kinds >= {"Header", "Message", "Metadata", "Attachment", "DataEnd", "Statistics"}
