"""What a run leaves on disk: whole when it ends, nearly whole when it is killed."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from log_samples import (
    LAYOUT,
    MJCF,
    OK,
    append_all,
    append_and_wait,
    blocks,
    recorder,
    rows,
    scenario,
    scene,
    write_log,
)
from mcap.reader import make_reader
from mcap.records import Message

from dnnmso_mj import recording
from dnnmso_mj.errors import LogError
from dnnmso_mj.log.writer import CHUNK_BYTES
from dnnmso_mj.reading import log_info, read_snapshots, read_trace
from dnnmso_mj.recording import McapRecorder
from dnnmso_mj.trace import Event, RunInfo, StepLayout

LOST_TICKS = 19  # that wait for more


def messages(path: Path, topic: str) -> list[Message]:
    with path.open("rb") as file:
        return [m for _, _, m in make_reader(file, validate_crcs=True).iter_messages(topic)]


@contextlib.contextmanager
def full_disk(limit: int) -> Iterator[None]:
    """Let no file grow beyond `limit` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextlib.contextmanager
def child_writing(log: Path, folder: Path, ticks: int) -> Iterator[tuple[subprocess.Popen, Path]]:
    """A process that appends so many ticks and then waits; and its counter of them."""
    counter = folder / "counter"
    counter.write_bytes(bytes(8))
    program = Path(sys.modules[append_and_wait.__module__].__file__)
    child = subprocess.Popen([sys.executable, str(program), str(log), str(counter), str(ticks)])
    try:
        yield child, counter
    finally:
        child.kill()
        child.wait()


def appended(counter: Path) -> int:
    return int.from_bytes(counter.read_bytes(), sys.byteorder)


def wait_until(condition: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < end, f"not within 20 s: {what}"
        time.sleep(1e-4)


def ticks_in(log: Path) -> int:
    """Ticks of a log that may not have begun yet."""
    try:
        return log_info(log).ticks
    except LogError:
        return 0


@pytest.mark.parametrize("ticks", np.random.default_rng(0).integers(1, 5000, 4).tolist())
def test_sigkill_loses_no_more_than_the_block_in_progress(tmp_path, ticks):
    log = tmp_path / "run.mcap"
    with child_writing(log, tmp_path, ticks) as (child, counter):
        wait_until(lambda: appended(counter) == ticks, "all appended")
        wait_until(lambda: ticks_in(log) >= ticks - LOST_TICKS, "the file has them")
        child.send_signal(signal.SIGKILL)
        assert child.wait(30) == -signal.SIGKILL
    info = log_info(log)
    assert not info.complete
    assert info.status == "unfinished"
    assert (info.scenario, info.seed) == ("sample", 7)
    assert "mujoco" in info.versions
    assert info.attachments == {"model.xml": len(MJCF)}
    assert ticks - LOST_TICKS <= info.ticks <= ticks
    if info.ticks:
        assert_rows(log)


@pytest.mark.parametrize("ticks", np.random.default_rng(2).integers(100, 5000, 3).tolist())
def test_sigkill_in_the_midst_of_writing_leaves_a_readable_prefix(tmp_path, ticks):
    log = tmp_path / "run.mcap"
    with child_writing(log, tmp_path, 100_000) as (child, counter):
        wait_until(lambda: appended(counter) >= ticks and ticks_in(log) > 0, "under way")
        child.send_signal(signal.SIGKILL)
        assert child.wait(30) == -signal.SIGKILL
    assert_rows(log)


def assert_rows(log: Path) -> None:
    trace = read_trace(log)
    expected = np.resize(rows(1000), (len(trace), LAYOUT.width))
    np.testing.assert_array_equal(trace["tau"], expected[:, LAYOUT.slices["tau"]])


@pytest.mark.parametrize("ticks", np.random.default_rng(1).integers(1, 5000, 3).tolist())
def test_ctrl_c_at_any_moment_leaves_a_complete_log_of_all_ticks(tmp_path, ticks):
    log = tmp_path / "run.mcap"
    with child_writing(log, tmp_path, 100_000) as (child, counter):
        wait_until(lambda: appended(counter) >= ticks, "under way")
        child.send_signal(signal.SIGINT)
        assert child.wait(30) == -signal.SIGINT  # how Python ends on a KeyboardInterrupt
    info = log_info(log)
    assert info.complete
    assert info.status == "interrupted"
    assert appended(counter) <= info.ticks <= appended(counter) + 30
    assert [m.sequence for m in messages(log, "/step")] == list(range(info.ticks))


@pytest.mark.parametrize("dt", [1e-5, 1e-3, 2.5e-3, 0.1])
def test_rows_reach_the_file_by_themselves(tmp_path, dt):
    log = tmp_path / "run.mcap"
    block = max(1, min(int(0.05 / dt), CHUNK_BYTES // 400))  # a row takes more than 400 bytes
    with recorder(log, dt=dt, duration=1000 * dt) as open_log:
        for first in range(0, 1000, 20):
            open_log.append(rows(20))
            waiting = first + 20 - block
            wait_until(lambda least=waiting: log_info(log).ticks >= least, f"{waiting} ticks")
        open_log.finish(OK)


def test_a_run_that_waited_for_its_disk_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "BACKLOG_BYTES", 0)
    log = McapRecorder(tmp_path / "run.mcap", LAYOUT, scenario(), scene(), MJCF, real_time=True)
    with log:
        log.append(rows(40))
        waited = log.waited_s
        assert waited > 0.0
        log.finish(OK)
    (event,) = log_info(tmp_path / "run.mcap").events
    assert (event.t, event.level) == (0.04, "warning")
    assert event.message == f"the run waited {waited:.3g} s for the disk that its log is on"


def test_a_run_that_did_not_wait_says_nothing(tmp_path):
    append_all(tmp_path / "run.mcap", rows(40))
    assert log_info(tmp_path / "run.mcap").events == ()


@pytest.mark.parametrize("dt", [1e-5, 1e-3, 3e-3])
def test_message_k_is_stamped_with_the_time_of_tick_k(tmp_path, dt):
    log = tmp_path / "run.mcap"
    write_log(log, 150, dt=dt, duration=150 * dt)
    step = messages(log, "/step")
    assert [m.log_time for m in step] == [round(k * dt * 1e9) for k in range(150)]
    assert [m.publish_time for m in step] == [m.log_time for m in step]
    assert [m.sequence for m in step] == list(range(150))


def test_a_finished_log_has_summary_statistics_and_indexes(tmp_path):
    log = tmp_path / "run.mcap"
    write_log(log, 230)
    with log.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert {c.compression for c in summary.chunk_indexes} == {"lz4"}
        assert max(c.uncompressed_size for c in summary.chunk_indexes) <= 64 * 1024
        topics = {channel.topic: id for id, channel in summary.channels.items()}
        counts = summary.statistics.channel_message_counts
        assert {topic: counts[id] for topic, id in topics.items()} == {
            "/step": 230,
            "/tf": 23,
            "/robot_description": 1,
            "/scene": 1,
            "/events": 1,
        }
        assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (
            0,
            229_000_000,
        )
        assert {a.name for a in reader.iter_attachments()} == {
            "model.xml",
            "snapshot/controller/0.0.npz",
            "snapshot/controller/0.2.npz",
        }
        names = Counter(m.name for m in reader.iter_metadata())
        assert set(names.values()) == {1}
        assert set(names) - {"git"} == {"scenario", "versions", "metrics", "run"}
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    assert json.loads(metadata["scenario"]["json"])["name"] == "sample"
    assert metadata["run"] == {"status": "ok", "reason": "", "seed": "7", "wall_s": "0.25"}
    assert json.loads(metadata["metrics"]["rmse"]) == 1.25e-4


def test_every_channel_carries_its_whole_schema(tmp_path):
    log = tmp_path / "run.mcap"
    write_log(log, 10)
    with log.open("rb") as file:
        summary = make_reader(file).get_summary()
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        if schema.encoding == "protobuf":
            files = FileDescriptorSet.FromString(schema.data).file
            assert {need for file in files for need in file.dependency} <= {f.name for f in files}
            assert schema.name in {f"{f.package}.{m.name}" for f in files for m in f.message_type}


@pytest.mark.parametrize(("dt", "stride"), [(1e-3, 10), (3e-3, 4), (0.05, 1)])
def test_frames_are_those_of_the_scene_at_no_more_than_100_hz(tmp_path, dt, stride):
    log = tmp_path / "run.mcap"
    data = write_log(log, 150, dt=dt, duration=150 * dt)
    found = messages(log, "/tf")
    assert [m.log_time for m in found] == [round(k * dt * 1e9) for k in range(0, 150, stride)]
    robot = scene()
    for message, row in zip(found, data[::stride], strict=True):
        transforms = FrameTransforms.FromString(message.data).transforms
        frames = [(t.parent_frame_id, t.child_frame_id) for t in transforms]
        assert frames == [
            ("world", "link1"),
            ("link1", "link2"),
            ("world", "ref/link1"),
            ("ref/link1", "ref/link2"),
        ]
        poses = [
            [*(getattr(t.translation, a) for a in "xyz"), *(getattr(t.rotation, a) for a in "xyzw")]
            for t in transforms
        ]
        arm, ghost = (robot.transforms(row[LAYOUT.slices[name]]) for name in ("q", "q_ref"))
        np.testing.assert_array_equal(poses, np.concatenate([arm, ghost]))
        stamp = transforms[0].timestamp
        assert stamp.seconds * 1_000_000_000 + stamp.nanos == message.log_time


def test_shapes_stand_where_the_model_has_them_and_a_ghost_beside_them(tmp_path):
    log = tmp_path / "run.mcap"
    write_log(log, 10)
    (message,) = messages(log, "/scene")
    entities = {e.frame_id: e for e in SceneUpdate.FromString(message.data).entities}
    assert list(entities) == ["world", "link1", "link2", "ref/link1", "ref/link2"]
    assert all(e.frame_locked for e in entities.values())
    (base,) = entities["world"].cubes
    assert base.size.x == pytest.approx(0.16)
    for frame in ("link1", "ref/link1"):  # a capsule from the joint to 1 m along x, a ball there
        (rod,) = entities[frame].cylinders
        assert (rod.size.x, rod.size.y, rod.size.z) == pytest.approx((0.07, 0.07, 1.0))
        balls = sorted((ball.size.x, ball.pose.position.x) for ball in entities[frame].spheres)
        np.testing.assert_allclose(balls, [(0.07, 0.0), (0.07, 1.0), (0.14, 1.0)], atol=1e-12)
    assert entities["link1"].cylinders[0].color.a == 1.0
    assert entities["ref/link1"].cylinders[0].color.a < 0.5


def test_events_are_foxglove_logs_at_their_times(tmp_path):
    log = tmp_path / "run.mcap"
    write_log(log, 10)
    (message,) = messages(log, "/events")
    event = Log.FromString(message.data)
    assert (message.log_time, event.timestamp.nanos) == (100_000_000, 100_000_000)
    assert (event.level, event.message) == (Log.WARNING, "torque limit reached")


def test_an_event_is_written_once_with_the_ticks_that_led_to_it(tmp_path):
    log = tmp_path / "run.mcap"
    with recorder(log) as open_log:
        for k, block in enumerate(blocks(rows(230))):
            open_log.append(block)
            open_log.event(Event(0.03 * k, "info", f"block {k}"))
        open_log.finish(OK)
    assert [e.message for e in log_info(log).events] == [f"block {k}" for k in range(8)]


def test_two_logs_of_the_same_rows_have_the_same_step_messages(tmp_path):
    for name in ("a", "b"):
        write_log(tmp_path / name, 120)
    a, b = (messages(tmp_path / name, "/step") for name in ("a", "b"))
    assert a == b


def test_append_and_snapshot_copy_what_they_are_given(tmp_path):
    log, block, weights = tmp_path / "run.mcap", rows(7), np.ones(3)
    with recorder(log) as open_log:
        open_log.append(block)
        open_log.snapshot("net", 0.0, {"W": weights})
        block[:], weights[:] = 0.0, 0.0
        assert open_log.ticks == 7
        open_log.finish(OK)
    np.testing.assert_array_equal(read_trace(log)["q"], rows(7)[:, LAYOUT.slices["q"]])
    np.testing.assert_array_equal(read_snapshots(log)[0].arrays["W"], np.ones(3))


@pytest.mark.parametrize("sizes", [[1] * 230, [50] * 5, [30, 200], [230], [0, 49, 1, 51, 129]])
def test_blocks_of_any_size_make_the_same_messages(tmp_path, sizes):
    data = rows(sum(sizes))
    with recorder(tmp_path / "run.mcap") as log:
        for end, size in zip(np.cumsum(sizes), sizes, strict=True):
            log.append(data[end - size : end])
        log.finish(OK)
    append_all(tmp_path / "other.mcap", data)
    found, expected = (messages(tmp_path / name, "/step") for name in ("run.mcap", "other.mcap"))
    assert found == expected


def test_a_diverged_row_is_logged_but_not_drawn(tmp_path):
    log, data = tmp_path / "run.mcap", rows(20)
    data[10, LAYOUT.slices["q"]] = [np.nan, np.inf]
    append_all(log, data, RunInfo(status="diverged", seed=7, reason="q = nan at t = 0.01 s"))
    np.testing.assert_array_equal(read_trace(log)["q"][10], [np.nan, np.inf])
    assert [m.sequence for m in messages(log, "/step")] == list(range(20))
    assert [m.log_time for m in messages(log, "/tf")] == [0]
    assert read_trace(log).info.reason == "q = nan at t = 0.01 s"


def test_an_exception_ends_the_log_as_failed_with_its_reason(tmp_path):
    log = tmp_path / "run.mcap"

    def run() -> None:
        with recorder(log) as open_log:
            open_log.append(rows(1))
            open_log.event(Event(0.0, "info", "about to divide"))
            raise ZeroDivisionError("division by zero")

    with pytest.raises(ZeroDivisionError):
        run()
    info = log_info(log)
    assert (info.complete, info.status, info.ticks) == (True, "failed", 1)
    assert info.reason == "ZeroDivisionError: division by zero"
    assert [event.message for event in info.events] == ["about to divide"]


def test_a_log_left_without_finish_is_failed(tmp_path):
    with recorder(tmp_path / "run.mcap") as open_log:
        open_log.append(rows(1))
    assert log_info(tmp_path / "run.mcap").status == "failed"


def test_a_metric_that_is_not_finite_is_refused_and_named(tmp_path):
    log = tmp_path / "run.mcap"
    info = RunInfo(status="ok", seed=7, metrics={"rmse": float("nan")})
    with pytest.raises(LogError, match="metric rmse = nan; allowed"):
        append_all(log, rows(3), info)
    assert (log_info(log).status, log_info(log).ticks) == ("failed", 3)


def test_snapshots_come_back_to_the_last_bit(tmp_path):
    arrays = {"W": np.random.default_rng(3).normal(size=(4, 3)), "k": np.array(12), "f": 0.1}
    with recorder(tmp_path / "run.mcap") as open_log:
        open_log.snapshot("net/madam", 0.1 + 0.2, arrays)
        open_log.finish(OK)
    (snapshot,) = read_snapshots(tmp_path / "run.mcap")
    assert (snapshot.name, snapshot.t) == ("net/madam", 0.1 + 0.2)
    assert set(snapshot.arrays) == set(arrays)
    for key, value in arrays.items():
        np.testing.assert_array_equal(snapshot.arrays[key], value)


def test_snapshots_take_no_python_objects(tmp_path):
    with recorder(tmp_path / "run.mcap") as open_log:
        with pytest.raises(LogError, match="array 'W' has dtype object; allowed"):
            open_log.snapshot("net", 0.0, {"W": np.array([None])})
        open_log.finish(OK)
    assert read_snapshots(tmp_path / "run.mcap") == []


def test_an_existing_file_is_refused_and_kept(tmp_path):
    log = tmp_path / "run.mcap"
    log.write_text("precious")
    with pytest.raises(LogError, match=r"run\.mcap exists already\. Choose another name"):
        recorder(log)
    assert log.read_text() == "precious"


def test_force_replaces_an_existing_log(tmp_path):
    log = tmp_path / "run.mcap"
    append_all(log, rows(70))
    with McapRecorder(log, LAYOUT, scenario(), scene(), MJCF, force=True) as open_log:
        open_log.finish(OK)
    assert (log_info(log).complete, log_info(log).ticks) == (True, 0)


@pytest.mark.parametrize("kind", ["scenario", "empty", "folder", "fifo", "link to nowhere"])
def test_force_replaces_nothing_that_is_no_log(tmp_path, kind):
    path = tmp_path / "paper.yaml"
    make = {
        "scenario": lambda: path.write_text("name: paper"),
        "empty": path.touch,
        "folder": path.mkdir,
        "fifo": lambda: os.mkfifo(path),
        "link to nowhere": lambda: path.symlink_to(tmp_path / "nowhere"),
    }
    make[kind]()
    before = path.lstat()
    with pytest.raises(LogError, match=r"paper\.yaml (is no log|exists already)"):
        McapRecorder(path, LAYOUT, scenario(), scene(), MJCF, force=True)
    assert (path.lstat().st_ino, path.lstat().st_size) == (before.st_ino, before.st_size)


def test_a_missing_folder_is_made(tmp_path):
    with recorder(tmp_path / "a" / "b" / "run.mcap") as open_log:
        open_log.finish(OK)
    assert log_info(tmp_path / "a" / "b" / "run.mcap").complete


def test_a_folder_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "logs").write_text("a file")
    with pytest.raises(LogError, match=r"logs/run\.mcap cannot be written: "):
        recorder(tmp_path / "logs" / "run.mcap")
    assert (tmp_path / "logs").read_text() == "a file"


def test_a_disk_full_at_the_start_leaves_nothing(tmp_path):
    with full_disk(1000), pytest.raises(LogError, match=r"run\.mcap cannot be written: File too"):
        recorder(tmp_path / "run.mcap")
    assert list(tmp_path.iterdir()) == []


def test_a_disk_full_on_the_way_is_named_and_leaves_the_prefix(tmp_path):
    log, data = tmp_path / "run.mcap", rows(400)
    with full_disk(100_000), pytest.raises(LogError, match=r"run\.mcap cannot be written: File"):
        append_all(log, data)
    trace = read_trace(log)
    assert trace.info.status == "unfinished"
    assert 50 <= len(trace) < 400
    np.testing.assert_array_equal(trace["f_hat"], data[: len(trace), LAYOUT.slices["f_hat"]])


def repeat(call: Callable[[McapRecorder], None], log: McapRecorder) -> None:
    """Call until it raises, for the thread meets the disk's end in its own time."""
    while True:
        call(log)


def test_a_write_that_failed_is_told_by_the_next_call_whatever_it_is(tmp_path):
    calls = {
        "append": lambda log: log.append(rows(1)),
        "event": lambda log: log.event(Event(0.0, "info", "hello")),
        "snapshot": lambda log: log.snapshot("net", 0.0, {}),
        "flush": lambda log: log.flush(),
        "finish": lambda log: log.finish(OK),
    }
    for name, call in calls.items():
        robot = scene()
        with (
            full_disk(60_000),
            McapRecorder(tmp_path / name, LAYOUT, scenario(), robot, MJCF, real_time=True) as log,
        ):
            log.append(rows(400))
            with pytest.raises(LogError, match="cannot be written: File too large"):
                repeat(call, log)


def test_a_controller_without_a_network_is_logged_too(tmp_path):
    layout = StepLayout(n_joints=2, n_layers=0)
    data = write_log(tmp_path / "run.mcap", 60, layout)
    trace = read_trace(tmp_path / "run.mcap")
    assert (trace.n_joints, trace.n_layers) == (2, 0)
    np.testing.assert_array_equal(trace["e_obs"], data[:, layout.slices["e_obs"]])
