"""A run in the viewer while it goes on: all of it arrives, and no viewer holds the run up."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from rerun_programs import children, contents, listening_addresses, ports_of, processes
from vulkan import needs_vulkan

from dnnmso_mj.cli.live import live_view
from dnnmso_mj.errors import DnnmsoError, MissingExtraError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.logged import LoggedRun
from dnnmso_mj.reading import log_info
from dnnmso_mj.replay import save_rrd
from dnnmso_mj.run import run_logged
from dnnmso_mj.viewer import live
from dnnmso_mj.viewer.live import connected, served, started, window
from dnnmso_mj.viewer.process import LOCAL, data_address, free_port, listens, rerun

pytestmark = [
    pytest.mark.filterwarnings("ignore:RRD file has no footer"),  # it is a stream's
    pytest.mark.filterwarnings("ignore:.*unstable even with an exact model"),  # that is meant
]
HEADLESS = ("--headless", "--window-size", "1200x700")
SMALL_NET = ("controller.network.hidden=[8, 8]", "imperfections.torque_limit=60")
CLOCKED = {"compute_us", "wake_late_us", "deadline_missed"}


@contextmanager
def recorder(out: Path) -> Iterator[str]:
    """A Rerun program that keeps what is streamed to it in a file; its address."""
    port = free_port()
    with rerun("--port", str(port), "--save", str(out)) as process:
        process.wait_until(lambda: listens(port), "ready")
        yield data_address(port)
        wait_until_written(out)


def wait_until_written(file: Path) -> None:
    """Until a Rerun program has put into a file what it has got: it is ended without mercy."""
    size, since = -1, time.monotonic()
    while time.monotonic() < since + 1.5:
        if size != (size := file.stat().st_size):
            since = time.monotonic()
        time.sleep(0.1)


@pytest.fixture(scope="module")
def streamed(tmp_path_factory) -> tuple[LoggedRun, Path]:
    """A run with a network, events and a limit it reaches, and what its viewer got."""
    folder = tmp_path_factory.mktemp("streamed")
    push = '[{"kind": "push", "at": 0.3, "duration": 0.1, "force": [20.0, 0.0, 0.0]}]'
    scenario = load_scenario("paper", (*SMALL_NET, "duration=1.2", f"events={push}"))
    with recorder(folder / "live.rrd") as address, connected(address) as view:
        done = run_logged(scenario, folder / "run.mcap", live=view)
    return done, folder / "live.rrd"


def test_what_arrives_is_what_a_replay_of_the_log_shows(streamed, tmp_path):
    """Every entity, every component, every tick; of levels and styles the last word counts."""
    done, got = streamed
    arrived, expected = contents(got), contents(save_rrd(done.log, tmp_path / "replay.rrd"))
    assert set(arrived) == set(expected)
    for entity, components in expected.items():
        assert set(arrived[entity]) == set(components), entity
        for name, pairs in components.items():
            last_word = pairs[0][0] == -1 or entity.endswith("/levels")
            some = slice(-1, None) if last_word else slice(None)
            assert repr(arrived[entity][name][some]) == repr(pairs[some]), (entity, name)  # nan


def test_a_run_with_a_viewer_is_the_run_without_one(streamed, tmp_path):
    done, _ = streamed
    alone = run_logged(done.trace.scenario, tmp_path / "alone.mcap")
    for name in set(alone.trace) - CLOCKED:
        assert np.array_equal(alone.trace[name], done.trace[name]), name
    assert log_info(done.log).channels == log_info(alone.log).channels


def test_a_burst_of_many_ticks_arrives_whole_in_a_viewer_that_outlives_the_run(tmp_path):
    """20 s simulated in less than one: far faster than a viewer takes it."""
    scenario = load_scenario("paper_no_network", ("duration=20",))
    with started("--save", str(tmp_path / "live.rrd")) as view:
        [group] = children()
        run_logged(scenario, tmp_path / "run.mcap", live=view)
    assert is_running(group)
    wait_until_written(tmp_path / "live.rrd")
    os.killpg(group, signal.SIGTERM)
    wait_until(lambda: not is_running(group))
    angles = contents(tmp_path / "live.rrd")["/plots/joint_angles/lines"]["Scalars:scalars"]
    assert [tick for tick, _ in angles] == list(range(20_000))


def test_a_viewer_does_not_outlive_a_run_that_never_was():
    with started("--serve-grpc"):
        [group] = children()
        assert is_running(group)
    assert not is_running(group)


def is_running(process: int) -> bool:
    """Whether a process runs; one that has ended is a zombie until it is waited for."""
    stat = Path(f"/proc/{process}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


def test_a_run_that_diverges_says_so_in_the_viewer(tmp_path):
    overrides = ("duration=0.2", "controller.inversion.K=[5000.0]")
    scenario = load_scenario("paper_no_network", overrides)
    with recorder(tmp_path / "live.rrd") as address, connected(address) as view:
        done = run_logged(scenario, tmp_path / "run.mcap", live=view)
    assert done.trace.info.status == "diverged"
    got = contents(tmp_path / "live.rrd")
    _, [text] = got["/summary"]["TextDocument:text"][-1]
    assert "diverged: " in text
    assert len(got["/plots/torque/lines"]["Scalars:scalars"]) == len(done.trace)


@contextmanager
def acting(at: int, act: Callable[[], None]) -> Iterator[Callable[[int], None]]:
    """A run's `progress` that does something once, when that many ticks are done."""
    done = 0

    def progress(ticks: int) -> None:
        nonlocal done
        before, done = done, done + ticks
        if before < at <= done:
            act()

    yield progress
    assert done >= at


def ten_seconds(folder: Path, **options) -> LoggedRun:
    return run_logged(load_scenario("paper_no_network"), folder / "run.mcap", **options)


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> LoggedRun:
    return ten_seconds(tmp_path_factory.mktemp("plain"))


def assert_untouched(done: LoggedRun, plain: LoggedRun) -> None:
    """The run is the one that it would have been without a viewer, and its log is whole."""
    info = log_info(done.log)
    assert (info.status, info.complete, info.ticks) == ("ok", True, 10_000)
    for name in set(plain.trace) - CLOCKED:
        assert np.array_equal(plain.trace[name], done.trace[name]), name


@needs_vulkan
def test_killing_the_viewer_changes_nothing(plain, tmp_path):
    with started(*HEADLESS) as view:
        [viewer] = children()

        def kill() -> None:
            os.killpg(viewer, signal.SIGKILL)

        with (
            acting(2000, kill) as progress,
            pytest.warns(UserWarning, match=r"did not get .* of 10,000 ticks, since it is gone"),
        ):
            done = ten_seconds(tmp_path, live=view, progress=progress)
    assert_untouched(done, plain)


def test_a_viewer_that_takes_nothing_costs_nothing_but_patience(
    plain, tmp_path, monkeypatch: pytest.MonkeyPatch
):
    """Stopped, its socket still accepts; what does not fit into the ring is left out."""
    monkeypatch.setattr(live, "_PATIENCE_S", 0.5)
    port = free_port()
    with rerun("--port", str(port), "--serve-grpc") as server:
        server.wait_until(lambda: listens(port), "ready")
        [group] = children()
        with connected(data_address(port), backlog=2**20) as view:
            os.killpg(group, signal.SIGSTOP)
            try:
                with pytest.warns(
                    UserWarning, match=r"of 10,000 ticks, since it took them too slowly"
                ):
                    done = ten_seconds(tmp_path, live=view)
            finally:
                os.killpg(group, signal.SIGCONT)
    assert not processes(b"streamer")
    assert_untouched(done, plain)


def test_where_there_is_no_viewer_the_run_goes_on(plain, tmp_path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(live, "_PATIENCE_S", 0.5)
    with (
        connected(data_address(free_port())) as view,
        pytest.warns(UserWarning, match=r"did not get 10,000 of 10,000 ticks"),
    ):
        done = ten_seconds(tmp_path, live=view)
    assert_untouched(done, plain)


def test_a_streamer_that_dies_is_told_by_its_last_words(plain, tmp_path):
    port = free_port()
    with rerun("--port", str(port), "--serve-grpc"), connected(data_address(port)) as view:

        def kill() -> None:
            wait_until(lambda: processes(b"streamer"))
            [streamer] = processes(b"streamer")
            os.kill(streamer, signal.SIGKILL)

        with acting(2000, kill) as progress, pytest.warns(UserWarning, match="did not get"):
            done = ten_seconds(tmp_path, live=view, progress=progress)
    assert_untouched(done, plain)


def test_an_address_that_is_none_is_told(plain, tmp_path):
    with (
        connected("nonsense") as view,
        pytest.warns(UserWarning, match=r"10,000 of 10,000 ticks, since .*nonsense"),
    ):
        done = ten_seconds(tmp_path, live=view)
    assert_untouched(done, plain)


def test_a_streamer_that_cannot_start_is_told_before_the_run(
    tmp_path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(live, "STREAMER", "dnnmso_mj.viewer.nowhere")
    with (
        pytest.raises(DnnmsoError, match=r"the live view cannot start: .*nowhere"),
        connected(data_address(free_port())) as view,
    ):
        ten_seconds(tmp_path, live=view)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("view", [window, lambda: served(free_port())])
def test_without_rerun_the_message_says_what_to_install(view, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError, match="pip install 'dnnmso_mj\\[viewer\\]'"), view():
        pass


def test_a_port_that_is_taken_is_refused():
    with socket.create_server((LOCAL, 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(DnnmsoError, match=f"port {port} of 127"), served(port):
            pass


def test_a_window_and_a_page_at_once_are_refused():
    with pytest.raises(DnnmsoError, match="--view and --serve: allowed: one of them"):
        live_view(view=True, serve=True, port=9090)


def dnnmso(*arguments: object, cwd: Path, **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "dnnmso_mj", "run", "paper_no_network", *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_without_a_display_view_is_refused_before_anything_runs(tmp_path):
    with dnnmso("--view", cwd=tmp_path, DISPLAY="", WAYLAND_DISPLAY="") as command:
        _, error = command.communicate(timeout=60)
    assert command.returncode == 2
    assert re.match(r"error: no display: .* Use --serve \(a browser\)", error)
    assert not list(tmp_path.iterdir())


def test_a_display_that_is_not_there_is_refused_before_anything_runs(
    tmp_path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", ":4711")
    with pytest.raises(DnnmsoError, match="Rerun's viewer ended before ready"), window():
        pass


@needs_vulkan
def test_serve_shows_the_run_to_this_machine_alone_until_ctrl_c(tmp_path):
    from rerun.experimental import ViewerClient

    with dnnmso("--serve", "--port", free_port(), "--no-plot", cwd=tmp_path) as command:
        try:
            address = command.stderr.readline().split()[-1]
            page, data = ports_of(address)
            with urllib.request.urlopen(address, timeout=10) as response:
                assert "Rerun" in response.read().decode()
            assert command.stderr.readline() == "The page stays until Ctrl-C.\n"
            for port in (page, data):
                assert listening_addresses(port) == {"0100007F"}  # 127.0.0.1
            port = free_port()
            with rerun("--port", str(port), *HEADLESS, "--connect", data_address(data)) as viewer:

                def whole() -> bool:
                    try:
                        state = ViewerClient.connect(data_address(port)).get_state()
                    except (ConnectionError, RuntimeError):
                        return False
                    lines = [line for r in state.recordings for line in r.timelines]
                    arrived = any(line.name == "tick" and line.end >= 9999 for line in lines)
                    return arrived and any(v.name == "Torque (N·m)" for v in state.views)

                assert viewer.wait_until(whole, "showing the whole run in the project's layout")
        finally:
            command.send_signal(signal.SIGINT)
        assert command.wait(timeout=20) == 0
    assert not any(listens(port) for port in (page, data))


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGKILL, -9)])
def test_a_run_that_is_ended_takes_its_page_along(tmp_path, number, status):
    arguments = ("--serve", "--port", free_port(), "--real-time", "--set", "duration=60")
    with dnnmso(*arguments, "--no-plot", cwd=tmp_path) as command:
        ports = ports_of(command.stderr.readline().split()[-1])
        log = tmp_path / "logs" / "paper_no_network.mcap"
        wait_until(lambda: log.exists() and log.stat().st_size > 200_000)
        command.send_signal(number)
        assert command.wait(timeout=20) == status
    wait_until(lambda: not any(listens(port) for port in ports))
    wait_until(lambda: not streams_to(data_address(ports[1])))
    found = log_info(log)
    assert found.status == ("interrupted" if status == 130 else "unfinished")
    assert found.ticks > 100


def streams_to(address: str) -> bool:
    """Whether any process has this address in its command."""
    commands = (folder / "cmdline" for folder in Path("/proc").iterdir() if folder.name.isdigit())
    for command in commands:
        with suppress(OSError):
            if address.encode() in command.read_bytes():
                return True
    return False


def wait_until(happened: Callable[[], object]) -> None:
    deadline = time.monotonic() + 30.0
    while not happened():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.alone
@needs_vulkan
def test_the_controller_is_as_fast_with_a_viewer_as_without(tmp_path, capsys):
    """In one run in real time whose viewer is stopped every other half second.

    Runs apart differ more by where their memory happens to lie than by who looks on.
    """
    scenario, half = load_scenario("paper", ("duration=10",)), 500
    done = 0

    def progress(ticks: int) -> None:
        nonlocal done
        before, done = done // half, done + ticks
        if done // half != before:
            stop = signal.SIGSTOP if done // half % 2 else signal.SIGCONT
            for group in (viewer_group, streamer):
                os.killpg(group, stop)

    port = free_port()
    with rerun("--port", str(port), *HEADLESS) as viewer:
        viewer.give_way()  # as the command has it
        viewer.wait_until(lambda: listens(port), "ready")
        [viewer_group] = children()
        with connected(data_address(port)) as view:
            wait_until(lambda: processes(b"viewer.streamer"))
            [streamer] = processes(b"viewer.streamer")
            run = run_logged(
                scenario, tmp_path / "run.mcap", real_time=True, live=view, progress=progress
            )
    ticks = np.arange(len(run.trace))
    settled = (ticks >= 1000) & (ticks % half >= 100)
    shown, without = (
        np.median(run.trace["compute_us"][settled & (ticks // half % 2 == stopped)])
        for stopped in (0, 1)
    )
    with capsys.disabled():
        print(f"\ncompute_us, median: {without:.2f} µs; with a viewer {shown:.2f} µs")
        print(f"ratio: {shown / without:.3f}")
    assert shown < 1.2 * without
