"""What the recorder promises whoever calls it, in one process; of files: test_recording.py."""

from __future__ import annotations

import io
import json
import os
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from log_samples import LAYOUT, MJCF, OK, recorder, rows, scenario, scene
from mcap.reader import make_reader
from mcap.records import Attachment
from test_log_writer import Watched
from test_recording import full_disk, repeat

from dnnmso_mj import recording
from dnnmso_mj.errors import LogError
from dnnmso_mj.log import content as content_module
from dnnmso_mj.log.content import LogContent
from dnnmso_mj.log.messages import HEADER_SIZE
from dnnmso_mj.log.step_message import StepFormat
from dnnmso_mj.log.writer import LogWriter
from dnnmso_mj.provenance import git_commit, software_versions
from dnnmso_mj.reading import log_info, read_snapshots, read_trace
from dnnmso_mj.recording import McapRecorder
from dnnmso_mj.trace import Event, RunInfo, StepLayout


def beside_messages(log: Path) -> tuple[dict[str, dict[str, str]], dict[str, Attachment]]:
    """Metadata and attachments of a log by name; each name once."""
    with log.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        metadata = [(m.name, m.metadata) for m in reader.iter_metadata()]
        attachments = [(a.name, a) for a in reader.iter_attachments()]
    assert len(dict(metadata)) == len(metadata)
    assert len(dict(attachments)) == len(attachments)
    return dict(metadata), dict(attachments)


def test_a_log_keeps_the_records_and_files_it_is_given_besides(tmp_path):
    log = tmp_path / "run.mcap"
    records, files = {"resumed": {"from": "a.mcap", "tick": "7"}}, {"asset/x.stl": b"\0solid"}
    with McapRecorder(
        log, LAYOUT, scenario(), scene(), MJCF, records=records, files=files
    ) as open_log:
        open_log.finish(OK)
    metadata, attachments = beside_messages(log)
    assert metadata["resumed"] == records["resumed"]
    assert json.loads(metadata["scenario"]["json"]) == json.loads(scenario().model_dump_json())
    assert metadata["versions"] == software_versions()
    assert metadata.get("git") == ({"commit": git_commit()} if git_commit() else None)
    assert set(metadata) - {"git"} == {"scenario", "versions", "resumed", "metrics", "run"}
    found = {name: (a.media_type, a.data, a.log_time) for name, a in attachments.items()}
    assert found == {
        "model.xml": ("application/xml", MJCF.encode(), 0),
        "asset/x.stl": ("application/octet-stream", b"\0solid", 0),
    }


def test_what_a_log_begins_with_can_be_read_before_the_first_row(tmp_path):
    with recorder(tmp_path / "run.mcap") as open_log:
        open_log.flush()
        info = log_info(tmp_path / "run.mcap")
        assert (info.scenario, info.ticks, info.complete) == ("sample", 0, False)
        assert info.attachments == {"model.xml": len(MJCF)}
        open_log.finish(OK)


def test_the_recorder_counts_ticks_and_takes_single_rows(tmp_path):
    data = rows(5)
    with recorder(tmp_path / "run.mcap") as open_log:
        assert (open_log.ticks, open_log.waited_s) == (0, 0.0)
        assert open_log.path == tmp_path / "run.mcap"
        open_log.append(data[0])
        open_log.append(data[1:1])
        assert open_log.ticks == 1
        open_log.append(data[1:])
        assert open_log.ticks == 5
        open_log.finish(OK)
    np.testing.assert_array_equal(
        read_trace(tmp_path / "run.mcap")["q"], data[:, LAYOUT.slices["q"]]
    )


def test_after_a_flush_everything_so_far_can_be_read(tmp_path):
    with recorder(tmp_path / "run.mcap") as open_log:
        for count in (3, 60, 61):
            open_log.append(rows(count)[open_log.ticks :])
            open_log.event(Event(1e-3 * count, "info", f"{count} ticks"))
            open_log.snapshot("net", 1e-3 * count, {"W": np.ones(count)})
            open_log.flush()
            info = log_info(tmp_path / "run.mcap")
            assert info.ticks == count
            assert info.events[-1].message == f"{count} ticks"
            assert read_snapshots(tmp_path / "run.mcap")[-1].arrays["W"].size == count
        open_log.finish(OK)


def test_a_flush_waits_for_a_slow_disk(tmp_path, monkeypatch):
    flush = LogContent.flush

    def slowly(content: LogContent) -> None:
        time.sleep(0.1)
        flush(content)

    with recorder(tmp_path / "run.mcap") as open_log:
        monkeypatch.setattr(LogContent, "flush", slowly)
        open_log.append(rows(3))
        assert open_log.flush() == 3
        assert log_info(tmp_path / "run.mcap").ticks == 3
        open_log.finish(OK)


def logging_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "dnnmso-log"]


def is_open_here(file: Path) -> bool:
    """Whether this process holds a descriptor of it, by whatever name it was opened."""
    for number in os.listdir("/proc/self/fd"):
        with suppress(OSError):  # the descriptor of the list itself
            if os.path.samestat(os.fstat(int(number)), file.stat()):
                return True
    return False


def test_a_finished_log_is_closed_and_nobody_waits_to_write_it(tmp_path):
    before = len(logging_threads())
    with recorder(tmp_path / "run.mcap") as open_log:
        open_log.append(rows(3))
        assert is_open_here(tmp_path / "run.mcap")
        open_log.finish(OK)
    assert not is_open_here(tmp_path / "run.mcap")
    assert len(logging_threads()) == before


def test_a_log_whose_name_was_taken_away_says_so_at_its_end(tmp_path):
    before = len(logging_threads())
    with recorder(tmp_path / "run.mcap") as open_log:
        open_log.append(rows(3))
        (tmp_path / "run.mcap").rename(tmp_path / "moved.mcap")
        with pytest.raises(LogError) as refused:
            open_log.finish(OK)
    what = "it was moved or removed while the run was writing"
    assert str(refused.value) == (
        f"{tmp_path / 'run.mcap'} cannot be written: {what}. Choose another place for it."
    )
    assert log_info(tmp_path / "moved.mcap").ticks == 3
    assert len(logging_threads()) == before


def test_links_are_drawn_wherever_both_arm_and_reference_are_somewhere(tmp_path):
    data = rows(40)
    data[10, LAYOUT.slices["q_ref"]] = np.nan
    data[20, LAYOUT.slices["q"]] = [np.nan, 0.0]
    with recorder(tmp_path / "run.mcap") as open_log:
        open_log.append(data)
        open_log.finish(OK)
    with (tmp_path / "run.mcap").open("rb") as file:
        times = [m.log_time for _, _, m in make_reader(file).iter_messages(topics=["/tf"])]
    assert times == [0, 30_000_000]


def leave(log: Path, error: BaseException) -> None:
    with recorder(log) as open_log:
        open_log.append(rows(2))
        raise error


@pytest.mark.parametrize(
    ("error", "status", "reason"),
    [
        (KeyboardInterrupt(), "interrupted", "KeyboardInterrupt: "),
        (ValueError("no such thing"), "failed", "ValueError: no such thing"),
        (SystemExit(3), "failed", "SystemExit: 3"),
    ],
    ids=["ctrl-c", "error", "exit"],
)
def test_an_exception_ends_the_log_with_its_status_seed_and_reason(tmp_path, error, status, reason):
    with pytest.raises(type(error)):
        leave(tmp_path / "run.mcap", error)
    info = log_info(tmp_path / "run.mcap")
    assert (info.complete, info.status, info.reason) == (True, status, reason)
    assert (info.seed, info.ticks) == (7, 2)


def test_a_log_left_without_finish_says_so(tmp_path):
    with recorder(tmp_path / "run.mcap") as open_log:
        open_log.append(rows(1))
    assert log_info(tmp_path / "run.mcap").reason == "left without finish()"


def test_a_finished_log_is_not_written_again_when_it_is_left(tmp_path):
    log = tmp_path / "run.mcap"

    def run() -> None:
        with recorder(log) as open_log:
            open_log.finish(RunInfo(status="ok", seed=3))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run()
    assert (log_info(log).status, log_info(log).seed, log_info(log).complete) == ("ok", 3, True)


def leave_on_a_full_disk(log: Path, error: Exception | None) -> None:
    """Whatever is written when the log is left meets the end of the disk."""
    with full_disk(20_000), recorder(log) as open_log:
        open_log._background.put_off(lambda: open_log._file.write(bytes(30_000)))
        if error is not None:
            raise error


def test_the_error_under_way_is_told_rather_than_that_of_the_disk(tmp_path):
    with pytest.raises(ZeroDivisionError):
        leave_on_a_full_disk(tmp_path / "run.mcap", ZeroDivisionError())


def test_a_disk_that_fails_at_the_end_is_told(tmp_path):
    with pytest.raises(LogError, match=r"run\.mcap cannot be written: File too"):
        leave_on_a_full_disk(tmp_path / "run.mcap", None)


def test_nothing_is_left_of_a_log_that_could_not_be_begun(tmp_path):
    with pytest.raises(AttributeError):
        McapRecorder(
            tmp_path / "run.mcap", LAYOUT, scenario(), scene(), MJCF, records={"x": {"k": 1}}
        )
    assert list(tmp_path.iterdir()) == []


def test_a_snapshot_is_of_its_time_whatever_else_is_written(tmp_path):
    log = tmp_path / "run.mcap"
    with recorder(log) as open_log:
        open_log.snapshot("net", 0.25, {"W": np.arange(3.0)})
        open_log.append(rows(10))
        open_log.finish(OK)
    _, attachments = beside_messages(log)
    snapshot = attachments["snapshot/net/0.25.npz"]
    assert (snapshot.log_time, snapshot.media_type) == (250_000_000, "application/zip")


def test_content_needs_no_records_nor_files_and_writes_rows_of_any_count():
    file = io.BytesIO()
    content = LogContent(LogWriter(file), LAYOUT, scenario(), scene())
    content.start(MJCF)
    content.take(rows(333))
    content.events.append(Event(0.5, "error", "late"))
    content.finish({"run": {"status": "ok"}})
    reader = make_reader(io.BytesIO(file.getvalue()), validate_crcs=True)
    counts = {channel.topic: 0 for channel in reader.get_summary().channels.values()}
    assert list(counts) == ["/step", "/tf", "/robot_description", "/scene", "/events"]
    times: dict[str, list[int]] = {topic: [] for topic in counts}
    for _, channel, message in reader.iter_messages():
        times[channel.topic].append(message.log_time)
    assert times["/step"] == [k * 1_000_000 for k in range(333)]
    assert times["/tf"] == [k * 10_000_000 for k in range(34)]
    assert (times["/robot_description"], times["/scene"]) == ([0], [0])
    assert times["/events"] == [500_000_000]
    assert [m.name for m in reader.iter_metadata()][-1] == "run"


# How much waits for a chunk to be full, and for how long: what a kill may cost.


class Clock:
    """In the place of the module `time`."""

    now = 100.0

    def monotonic(self) -> float:
        return self.now

    perf_counter = monotonic


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    stopped = Clock()
    monkeypatch.setattr(content_module, "time", stopped)
    monkeypatch.setattr(recording, "time", stopped)
    return stopped


def begun(dt: float, layout: StepLayout = LAYOUT) -> tuple[LogContent, io.BytesIO]:
    file = io.BytesIO()
    content = LogContent(LogWriter(file), layout, scenario(dt=dt, duration=1000 * dt), scene())
    content.start(MJCF)
    return content, file


def chunks(content: LogContent, file: io.BytesIO) -> list[int]:
    """Ticks in each chunk that has any, as it is finished now."""
    content.finish({})
    reader = make_reader(io.BytesIO(file.getvalue()))
    times = [m.log_time for _, _, m in reader.iter_messages("/step")]
    spans = [(c.message_start_time, c.message_end_time) for c in reader.get_summary().chunk_indexes]
    return [sum(first <= t <= last for t in times) for first, last in spans][1:]


def test_rows_wait_until_they_are_of_a_fiftieth_of_a_second_and_never_more_than_fifty(clock):
    content, file = begun(1e-3)
    for count in (19, 1, 70, 45, 3):
        content.take(rows(count))
    assert chunks(content, file) == [20, 50, 20, 45, 3]


@pytest.mark.parametrize("ticks", range(1, 51))
def test_as_many_ticks_wait_as_fit_in_a_fiftieth_of_a_second(clock, ticks):
    content, file = begun(0.02 / ticks)
    for _ in range(2 * ticks):
        content.take(rows(1))
    assert chunks(content, file) == [ticks, ticks]


def test_a_tick_longer_than_the_wait_is_written_at_once(clock):
    content, file = begun(0.1)
    for _ in range(3):
        content.take(rows(1))
    assert chunks(content, file) == [1, 1, 1]


@pytest.mark.parametrize("layers", [100, 400, 4000])
def test_rows_too_wide_for_fifty_go_by_as_many_as_fit_in_64_kib(clock, layers):
    layout = StepLayout(n_joints=2, n_layers=layers)
    size = HEADER_SIZE + StepFormat(layout).size
    fitting = max(1, 64 * 1024 // size)
    content, file = begun(1e-5, layout)
    content.take(rows(2 * fitting + 1, layout))
    content.finish({})
    reader = make_reader(io.BytesIO(file.getvalue()))
    index = [c for c in reader.get_summary().chunk_indexes if c.uncompressed_size >= size]
    assert len([c for c in index if c.uncompressed_size // size == fitting]) >= 2
    assert len(list(reader.iter_messages("/step"))) == 2 * fitting + 1


def test_rows_that_have_waited_long_enough_on_the_wall_go_with_the_next(clock):
    content, file = begun(1e-3)
    for now in (100.0, 100.015, 100.021, 100.03, 100.04, 100.05):
        clock.now = now
        content.take(rows(1))
    assert chunks(content, file) == [3, 3]


@pytest.mark.parametrize(
    ("real_time", "seconds", "least"), [(False, 0.04, 10), (True, 0.02, 1)], ids=["fast", "paced"]
)
def test_a_block_is_of_a_short_time_and_of_no_more_than_fifty_ticks(real_time, seconds, least):
    for ticks in range(1, 120):
        expected = min(50, max(least, ticks))
        assert recording.ticks_in_a_block(seconds / ticks, real_time) == expected
    assert recording.ticks_in_a_block(1.0, real_time) == least


def test_blocks_begin_small_and_become_as_long_as_the_loop_is_fast(tmp_path, clock):
    with recorder(tmp_path / "run.mcap") as log:
        assert log.block == 10
        for seconds, count, block in (
            (0.125, 16, 5),  # 0.04 s of 1/128 s each
            (0.125, 16, 5),
            (1.0, 1, 1),  # slower than a block for each
            (1 / 128, 1, 5),
            (1 / 128, 0, 5),
            (0.0, 10, 40),  # no more than 0.04 s of the run
        ):
            clock.now += seconds
            log.append(rows(count))
            assert log.block == block
        log.finish(OK)


def test_a_paced_run_of_long_ticks_begins_with_blocks_as_short(tmp_path):
    parts = scenario(dt=0.01), scene(), MJCF
    with McapRecorder(tmp_path / "run.mcap", LAYOUT, *parts, real_time=True) as log:
        assert log.block == 2
        log.finish(OK)


@pytest.fixture
def gate() -> Iterator[threading.Event]:
    """What the writing thread waits for; it opens by itself rather than to hang a test."""
    closed = threading.Event()
    opener = threading.Timer(20.0, closed.set)
    opener.start()
    yield closed
    closed.set()
    opener.cancel()


def append_behind(log: McapRecorder, gate: threading.Event) -> None:
    """Append a row, which waits until the gate is opened meanwhile."""
    assert (log.waited_s, gate.is_set()) == (0.0, False)
    threading.Timer(0.05, gate.set).start()
    log.append(rows(1))
    assert gate.is_set()
    assert log.waited_s > 0.0


def test_a_run_without_deadlines_waits_for_one_block_behind_it(tmp_path, gate):
    with recorder(tmp_path / "run.mcap") as log:
        log._background.put(gate.wait)
        log.append(rows(40))
        append_behind(log, gate)
        log.finish(OK)


def test_a_snapshot_counts_among_what_waits(tmp_path, gate):
    with recorder(tmp_path / "run.mcap") as log:
        log._background.put(gate.wait)
        log.snapshot("net", 0.0, {"W": np.zeros(20 * LAYOUT.width), "v": np.zeros(LAYOUT.width)})
        log.append(rows(19))
        append_behind(log, gate)
        log.finish(OK)


def test_a_run_with_deadlines_does_not_wait(tmp_path, gate):
    parts = scenario(), scene(), MJCF
    with McapRecorder(tmp_path / "run.mcap", LAYOUT, *parts, real_time=True) as log:
        log._background.put(gate.wait)
        log.append(rows(400))
        assert (log.waited_s, gate.is_set()) == (0.0, False)
        gate.set()
        log.finish(OK)


def test_a_log_is_broken_only_once_it_could_not_be_written(tmp_path):
    with recorder(tmp_path / "whole.mcap") as log:
        assert log.broken is False
        log.finish(OK)
    assert log.broken is False
    log = recorder(tmp_path / "torn.mcap")
    with full_disk(20_000), pytest.raises(LogError):
        repeat(lambda log: log.append(rows(40)), log)
    assert log.broken is True


def test_a_snapshot_that_is_refused_is_named(tmp_path):
    with recorder(tmp_path / "run.mcap") as log:
        with pytest.raises(LogError, match=r"^snapshot 'net': array 'W' has dtype object; allowed"):
            log.snapshot("net", 0.0, {"v": np.ones(1), "W": np.array([None])})
        log.finish(OK)


def test_what_was_written_can_be_read_even_where_its_name_was_taken_away(tmp_path):
    with recorder(tmp_path / "run.mcap") as log:
        log.append(rows(60))
        log.flush()
        assert log.readable == log.path
        log.path.rename(tmp_path / "moved.mcap")
        assert log.readable != log.path
        assert log.readable.read_bytes() == (tmp_path / "moved.mcap").read_bytes()
        with pytest.raises(LogError, match="moved or removed while the run was writing"):
            log.finish(OK)
        assert log.broken is True
        assert log.readable == log.path


def test_a_snapshot_is_with_the_operating_system_at_once():
    file = Watched()
    content = LogContent(LogWriter(file), LAYOUT, scenario(), scene())
    content.start(MJCF)
    content.attach_snapshot("net", 0.0, {"W": np.ones(3)})
    assert file.flushed == len(file.getvalue())
    assert b"snapshot/net/0.0.npz" in file.getvalue()
