"""What the recorder promises whoever calls it, in one process; of files: test_recording.py."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from log_samples import LAYOUT, MJCF, OK, recorder, rows, scenario, scene
from mcap.reader import make_reader
from mcap.records import Attachment
from test_recording import full_disk

from dnnmso_mj.errors import LogError
from dnnmso_mj.log.content import LogContent
from dnnmso_mj.log.writer import LogWriter
from dnnmso_mj.provenance import git_commit, software_versions
from dnnmso_mj.reading import log_info, read_snapshots, read_trace
from dnnmso_mj.recording import McapRecorder
from dnnmso_mj.trace import Event, RunInfo


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
