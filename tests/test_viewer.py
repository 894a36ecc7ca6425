"""The viewer really shows a log: without a window, to a browser, and not where it cannot."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from vulkan import needs_vulkan

from dnnmso_mj.errors import DnnmsoError, LogError, MissingExtraError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.replay import open_viewer, save_rrd, screenshot, serve
from dnnmso_mj.run import run_logged
from dnnmso_mj.viewer.process import LOCAL, free_port, headless_viewer, listens, picture, rerun
from dnnmso_mj.viewer.signals import JOINT_COLORS

SIZE = (1200, 700)
TRAIL = (255, 220, 90)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("log") / "paper.mcap"
    overrides = (
        "duration=0.6",
        "controller.network.hidden=[8, 8]",
        "imperfections.torque_limit=60",
    )
    return run_logged(load_scenario("paper", overrides), out).log


def pixels(png: Path) -> np.ndarray:
    """The picture as integers, shape (height, width, 3)."""
    return np.round(imread(png)[..., :3] * 255).astype(int)


def count(image: np.ndarray, color: tuple[int, int, int], tolerance: int = 12) -> int:
    return int((np.abs(image - np.array(color)).max(axis=-1) <= tolerance).sum())


@needs_vulkan
@pytest.mark.parametrize("tab", ["Tracking", "Motion", "Learning", "Theory", "Timing"])
def test_every_tab_shows_its_plots_and_the_arm(log: Path, tmp_path: Path, tab: str) -> None:
    """`screenshot` raises when a view reports that it cannot show its data."""
    image = pixels(screenshot(log, tmp_path / "shown.png", tab=tab, size=SIZE))
    assert image.shape == (SIZE[1], SIZE[0], 3)
    arm, plots = image[:500, :480], image[:, 480:]
    blue, orange = JOINT_COLORS[:2]
    assert count(arm, TRAIL) > 50
    assert count(arm, blue, 60) > 40  # the pin of joint 1
    if tab == "Theory":
        assert count(plots, (235, 235, 235)) > 200  # the bounds, and η
    else:
        assert count(plots, blue) > 200
    if tab != "Timing":
        assert count(plots, orange) > 200
    assert list(tmp_path.iterdir()) == [tmp_path / "shown.png"]


@needs_vulkan
def test_the_arm_moves_with_time(log: Path, tmp_path: Path) -> None:
    first = pixels(screenshot(log, tmp_path / "first.png", t=0.0, size=SIZE))[40:500, :480]
    last = pixels(screenshot(log, tmp_path / "last.png", size=SIZE))[40:500, :480]
    assert (np.abs(first - last).max(axis=-1) > 30).sum() > 500
    assert count(first, TRAIL) < 20 < count(last, TRAIL)  # the trail is what has been gone


@needs_vulkan
def test_a_loaded_log_has_its_whole_time_and_no_complaints(log: Path, tmp_path: Path) -> None:
    rrd = save_rrd(log, tmp_path / "paper.rrd")
    with headless_viewer(rrd, SIZE) as client:
        picture(client)
        state = client.get_state()
        [recording] = state.recordings
        timelines = {line.name: (line.start, line.end) for line in recording.timelines}
        assert timelines == {"time": (0, 599_000_000), "tick": (0, 599)}
        assert recording.current_timeline == "time"
        assert {"Joint angles (rad)", "Torque (N·m)", "Run", "Events"} <= {
            view.name for view in state.views
        }
        assert [entry for entry in client.get_logs() if entry.level == "ERROR"] == []


@needs_vulkan
def test_a_view_that_cannot_be_drawn_is_an_error(tmp_path: Path) -> None:
    import rerun as rr
    import rerun.blueprint as rrb

    rrd = tmp_path / "broken.rrd"
    recording = rr.RecordingStream("test")
    no_lines = rrb.TimeSeriesView(name="Broken", overrides={"point": [rr.SeriesLines()]})
    recording.save(rrd, default_blueprint=no_lines)
    recording.log("point", rr.Points3D([[0, 0, 0]]))
    recording.disconnect()
    with (
        headless_viewer(rrd, SIZE) as client,
        pytest.raises(DnnmsoError, match="cannot show all views: Broken"),
    ):
        picture(client)


@needs_vulkan
def test_a_time_outside_the_run_is_refused(log: Path, tmp_path: Path) -> None:
    with pytest.raises(DnnmsoError, match=r"t = 7\.0 s; allowed: 0 to 0\.599 s"):
        screenshot(log, tmp_path / "never.png", t=7.0)
    assert not list(tmp_path.iterdir())


@needs_vulkan
def test_a_viewer_that_dies_is_an_error_not_a_traceback(log: Path, tmp_path: Path) -> None:
    rrd = save_rrd(log, tmp_path / "paper.rrd")

    def look_while_it_dies() -> None:
        with headless_viewer(rrd, SIZE) as client:
            [group] = children()
            os.killpg(group, signal.SIGKILL)
            picture(client)

    with pytest.raises(DnnmsoError, match="Rerun's viewer failed"):
        look_while_it_dies()


def children() -> list[int]:
    """The Rerun programs that this process has started and that still run; each leads a group."""
    pids = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
    return [int(pid) for pid in pids if b"rerun_cli" in Path(f"/proc/{pid}/cmdline").read_bytes()]


def test_without_a_vulkan_driver_the_message_names_the_packages(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VK_DRIVER_FILES", "/nonexistent")
    monkeypatch.setenv("VK_ICD_FILENAMES", "/nonexistent")
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/nonexistent")
    with pytest.raises(MissingExtraError, match="apt-get install mesa-vulkan-drivers libvulkan1"):
        screenshot(log, tmp_path / "never.png")
    assert not list(tmp_path.iterdir())


def test_a_picture_must_be_named_png(log: Path) -> None:
    with pytest.raises(LogError, match=r"allowed: a file name that ends in \.png"):
        screenshot(log, log)


def test_without_a_display_the_message_says_what_to_do(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(DnnmsoError, match=r"no display: .* --serve"):
        open_viewer(log)


def test_a_display_that_is_not_there_is_an_error(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", ":4711")
    with pytest.raises(DnnmsoError, match="Rerun's viewer failed: Error"):
        open_viewer(log)


def test_a_port_that_is_taken_is_refused(log: Path) -> None:
    with socket.socket() as taken:
        taken.bind((LOCAL, 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(DnnmsoError, match=f"port {port} of 127.0.0.1 cannot be used"):
            serve(log, port)


@pytest.mark.parametrize("port", [70000, -1])
def test_a_port_that_does_not_exist_is_refused(log: Path, port: int) -> None:
    with pytest.raises(DnnmsoError, match=f"port {port} of 127.0.0.1 cannot be used"):
        serve(log, port)


@pytest.fixture
def server(log: Path, tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A process that serves the log, and the address that it printed."""
    code = (
        "import sys; from pathlib import Path; from dnnmso_mj.replay import serve\n"
        "serve(Path(sys.argv[1]), int(sys.argv[2]))"
    )
    command = [sys.executable, "-c", code, str(log), str(free_port())]
    environment = {**os.environ, "TMPDIR": str(tmp_path)}  # what a killed one leaves goes there
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None
        yield process, process.stdout.readline().strip()
        process.terminate()


def ports_of(address: str) -> tuple[int, int]:
    """Of the page, and of the data that it loads."""
    url = urllib.parse.urlsplit(address)
    data = urllib.parse.parse_qs(url.query)["url"][0]
    assert data.startswith(f"rerun+http://{LOCAL}:")
    return int(url.port or 0), int(re.findall(r":(\d+)/proxy", data)[0])


def listening_addresses(port: int) -> set[str]:
    """Local addresses, as the kernel writes them, on which somebody listens at a port."""
    listening = "0A"
    return {
        address
        for table in ("/proc/net/tcp", "/proc/net/tcp6")
        for fields in (line.split() for line in Path(table).read_text().splitlines()[1:])
        for address, hex_port in [fields[1].split(":")]
        if int(hex_port, 16) == port and fields[3] == listening
    }


def test_a_served_log_is_for_this_machine_only(server: tuple[subprocess.Popen[str], str]) -> None:
    _, address = server
    with urllib.request.urlopen(address, timeout=10) as response:
        assert response.status == 200
        assert "Rerun" in response.read().decode()
    for port in ports_of(address):
        assert listening_addresses(port) == {"0100007F"}  # 127.0.0.1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_serving_ends_clean(
    server: tuple[subprocess.Popen[str], str], number: signal.Signals
) -> None:
    process, address = server
    assert all(listens(port) for port in ports_of(address))
    process.send_signal(number)
    assert process.wait(timeout=20) == 0
    assert not any(listens(port) for port in ports_of(address))


def test_a_killed_server_leaves_nothing_running(
    server: tuple[subprocess.Popen[str], str],
) -> None:
    process, address = server
    process.kill()
    process.wait()
    deadline = time.monotonic() + 20.0
    while any(listens(port) for port in ports_of(address)):
        assert time.monotonic() < deadline, "Rerun's server outlived the program that started it"
        time.sleep(0.05)


@needs_vulkan
def test_a_served_log_reaches_a_viewer(server: tuple[subprocess.Popen[str], str]) -> None:
    from rerun.experimental import ViewerClient

    _, data_port = ports_of(server[1])
    port, data = free_port(), f"rerun+http://{LOCAL}:{data_port}/proxy"
    arguments = ("--headless", "--port", str(port), "--window-size", "800x600", "--connect", data)
    with rerun(*arguments) as viewer:

        def laid_out() -> bool:
            try:
                state = ViewerClient.connect(f"rerun+http://{LOCAL}:{port}/proxy").get_state()
            except (ConnectionError, RuntimeError):
                return False
            return "Joint angles (rad)" in {view.name for view in state.views}

        assert viewer.wait_until(laid_out, "showing the log in the project's layout")
