"""The viewer really shows a log: without a window, to a browser, and not where it cannot."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.parse
import urllib.request
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from matplotlib.image import imread
from replay_samples import opened_tabs
from rerun_programs import children, listening_addresses, ports_of
from vulkan import needs_vulkan

from dnnmso_mj.errors import DnnmsoError, LogError, MissingExtraError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.replay import open_viewer, save_rrd, screenshot, serve
from dnnmso_mj.run import run_logged
from dnnmso_mj.viewer.plot import JOINT_COLORS
from dnnmso_mj.viewer.process import LOCAL, free_port, headless_viewer, listens, picture, rerun

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

SIZE = (1200, 700)
LEFT = 300  # px, the width of the arm's column
TRAIL = (255, 220, 90)
AT_LIMIT = (172, 141, 0)  # the viewer draws bands darker than it is told
BLUE, ORANGE = JOINT_COLORS[:2]
WHITE = (235, 235, 235)
# Tab -> colours that each of its columns of plots must show, from left to right.
SHOWN = {
    "Tracking": [(BLUE, ORANGE), (BLUE, ORANGE)],
    "Learning": [(BLUE, ORANGE, WHITE), ((240, 110, 210), (0, 105, 160))],
    "Theory": [((240, 110, 210), WHITE), (WHITE, BLUE, ORANGE)],
    "Timing": [(BLUE, WHITE)],
    "Scene": [(TRAIL, BLUE)],
}


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("log") / "paper.mcap"
    overrides = (
        "duration=0.6",
        "controller.network.hidden=[8, 8]",
        "imperfections.torque_limit=60",
    )
    return run_logged(load_scenario("paper", overrides), out).log


@pytest.fixture(scope="module")
def rrd(log: Path) -> Path:
    return save_rrd(log, log.with_suffix(".rrd"))


@pytest.fixture(scope="module")
def viewer(rrd: Path) -> Iterator[ViewerClient]:
    """One viewer for all that can be tried in it, at the end of the run."""
    with headless_viewer(rrd, SIZE) as client:
        client.set_time("time", duration=0.6, play_state="paused")
        yield client


def pixels(png: Path | bytes) -> np.ndarray:
    """The picture as integers, shape (height, width, 3)."""
    source = BytesIO(png) if isinstance(png, bytes) else png
    return np.round(imread(source, format="png")[..., :3] * 255).astype(int)


def count(image: np.ndarray, color: tuple[int, int, int], tolerance: int = 12) -> int:
    return int((np.abs(image - np.array(color)).max(axis=-1) <= tolerance).sum())


@needs_vulkan
def test_every_tab_shows_the_arm_what_happens_and_its_plots(viewer: ViewerClient) -> None:
    """`picture` raises when a view reports that it cannot show its data."""
    seen = []
    for tab in opened_tabs(viewer):
        image = pixels(picture(viewer))
        seen.append(tab)
        assert image.shape == (SIZE[1], SIZE[0], 3)
        arm, plots = image[40:300, :LEFT], image[60:, LEFT:]
        assert count(arm, TRAIL) > 30
        assert count(arm, BLUE, 60) > 10  # the pin of joint 1
        for column, colors in zip(
            np.array_split(plots, len(SHOWN[tab]), 1), SHOWN[tab], strict=True
        ):
            assert count(column, AT_LIMIT) > 1000, tab
            for color in colors:
                assert count(column, color, 30) > 100, (tab, color)
    assert seen == list(SHOWN)
    errors = [entry for entry in viewer.get_logs() if entry.level == "ERROR"]
    assert errors == []


@needs_vulkan
def test_the_arm_moves_with_time(viewer: ViewerClient) -> None:
    images = []
    for t in (0.0, 0.6):
        viewer.set_time("time", duration=t, play_state="paused")
        images.append(pixels(picture(viewer))[40:300, :LEFT])
    first, last = images
    assert (np.abs(first - last).max(axis=-1) > 30).sum() > 300
    assert count(first, TRAIL) < 20 < count(last, TRAIL)  # the trail is what has been gone


@needs_vulkan
def test_a_loaded_log_has_its_whole_time(viewer: ViewerClient) -> None:
    [recording] = viewer.get_state().recordings
    timelines = {line.name: (line.start, line.end) for line in recording.timelines}
    assert timelines == {"time": (0, 600_000_000), "tick": (0, 600)}
    assert recording.current_timeline == "time"


@needs_vulkan
def test_two_logs_are_compared_in_one_picture(log: Path, tmp_path: Path) -> None:
    other = run_logged(
        load_scenario("paper", ("duration=0.3",), controller="pd"), tmp_path / "pd.mcap"
    )
    image = pixels(screenshot([log, other.log], tmp_path / "both.png", size=(1200, 900)))
    assert {path.name for path in tmp_path.iterdir()} == {"both.png", "pd.mcap"}
    arms, plots = image[40:400, :LEFT], image[200:, LEFT:]
    for color in (BLUE, ORANGE):
        assert count(plots, color, 30) > 200
        assert count(arms, color, 60) > 30
    band = np.abs(image[60:200, LEFT:] - 0.55 * np.array(ORANGE)).max(axis=-1) < 12
    wide = np.flatnonzero(band.sum(axis=0) > 10)  # half of each of two columns of plots
    assert 400 < wide.size < 500


@needs_vulkan
def test_a_picture_is_of_its_time_and_its_tab(log: Path, tmp_path: Path) -> None:
    image = pixels(screenshot(log, tmp_path / "first.png", t=0.0, tab="Scene", size=SIZE))
    assert count(image, TRAIL) < 20
    assert count(image[200:500, LEFT:], BLUE, 60) > 50  # the large arm's first pin
    assert list(tmp_path.iterdir()) == [tmp_path / "first.png"]


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
    with pytest.raises(DnnmsoError, match=r"t = 7\.0 s; allowed: 0 to 0\.6 s"):
        screenshot(log, tmp_path / "never.png", t=7.0)
    assert not list(tmp_path.iterdir())


@needs_vulkan
def test_a_viewer_that_dies_is_an_error_not_a_traceback(rrd: Path) -> None:
    before = set(children())

    def look_while_it_dies() -> None:
        with headless_viewer(rrd, SIZE) as client:
            [group] = set(children()) - before
            os.killpg(group, signal.SIGKILL)
            picture(client)

    with pytest.raises(DnnmsoError, match="Rerun's viewer failed"):
        look_while_it_dies()


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


Server = tuple[subprocess.Popen[str], str]


@contextlib.contextmanager
def serving(log: Path, folder: Path) -> Iterator[Server]:
    """A process that serves the log, and the address that it printed."""
    code = (
        "import sys; from pathlib import Path; from dnnmso_mj.replay import serve\n"
        "serve(Path(sys.argv[1]), int(sys.argv[2]))"
    )
    command = [sys.executable, "-c", code, str(log), str(free_port())]
    environment = {**os.environ, "TMPDIR": str(folder)}  # what a killed one leaves goes there
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None
        yield process, process.stdout.readline().strip()
        process.terminate()


@pytest.fixture
def server(log: Path, tmp_path: Path) -> Iterator[Server]:
    """One that a test may end."""
    with serving(log, tmp_path) as served:
        yield served


@pytest.fixture(scope="module")
def lasting_server(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """One that no test ends."""
    with serving(log, tmp_path_factory.mktemp("served")) as served:
        yield served


def test_a_served_log_is_for_this_machine_only(lasting_server: Server) -> None:
    _, address = lasting_server
    with urllib.request.urlopen(address, timeout=10) as response:
        assert response.status == 200
        assert "Rerun" in response.read().decode()
    for port in ports_of(address):
        assert listening_addresses(port) == {"0100007F"}  # 127.0.0.1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_serving_ends_clean(server: Server, number: signal.Signals) -> None:
    process, address = server
    assert all(listens(port) for port in ports_of(address))
    process.send_signal(number)
    assert process.wait(timeout=20) == 0
    assert not any(listens(port) for port in ports_of(address))


def test_a_killed_server_leaves_nothing_running(
    server: Server,
) -> None:
    process, address = server
    process.kill()
    process.wait()
    deadline = time.monotonic() + 20.0
    while any(listens(port) for port in ports_of(address)):
        assert time.monotonic() < deadline, "Rerun's server outlived the program that started it"
        time.sleep(0.05)


@needs_vulkan
def test_a_served_log_reaches_a_viewer(lasting_server: Server) -> None:
    from rerun.experimental import ViewerClient

    _, data_port = ports_of(lasting_server[1])
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
