"""Draw the pictures of README and docs anew: `make figures`.

Runs the paper with and without its network, and once in real time with much that happens to it;
keeps the figures and viewer screenshots of them.
"""

from __future__ import annotations

import shutil
import tempfile
import threading
from pathlib import Path

from dnnmso_mj.loading import load_scenario
from dnnmso_mj.plots import save_figures
from dnnmso_mj.replay import screenshot
from dnnmso_mj.run import run_logged
from dnnmso_mj.viewer.live import connected
from dnnmso_mj.viewer.process import data_address, free_port, listens, rerun

IMAGES = Path(__file__).parent / "images"
# Hung up for a moment, loaded, pushed, unloaded, and in the end left to what it knows.
EVENTFUL = (
    "description=Much happens to it.",
    "imperfections.torque_limit=80",
    "real_time.stalls=[{at: 1.5, duration: 0.2}]",
    "events=[{kind: payload, at: 3.0, mass: 0.3}, {kind: payload, at: 6.5, mass: -0.3}, "
    "{kind: push, at: 5.0, duration: 0.3, torque: [10.0, 5.0]}, {kind: freeze, at: 9.0}]",
)


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        draw_figures(folder)
        take_screenshots(folder)
        draw_live(folder, IMAGES / "live.png")
    for image in sorted(IMAGES.glob("*.png")):
        print(image)


def draw_figures(folder: Path) -> None:
    """The paper's figures, from logs that stay in the folder."""
    for name in ("paper", "paper_no_network"):
        run = run_logged(load_scenario(name), folder / f"{name}.mcap")
        save_figures(run.trace, folder, name)
    for kind in ("tracking", "error", "torque", "learning", "theory"):
        shutil.copy(folder / f"paper_{kind}.png", IMAGES / f"{kind}.png")
    shutil.copy(folder / "paper_no_network_tracking.png", IMAGES / "tracking_no_network.png")


def take_screenshots(folder: Path) -> None:
    """Every tab of the viewer, from the logs of `draw_figures`."""
    paper, plain = folder / "paper.mcap", folder / "paper_no_network.mcap"
    for tab in ("Tracking", "Learning", "Theory"):
        screenshot(paper, IMAGES / f"replay_{tab.lower()}.png", tab=tab)
    scenario = load_scenario("push", EVENTFUL)
    eventful = run_logged(scenario, folder / "push.mcap", real_time=True).log
    for tab in ("Timing", "Scene"):
        screenshot(eventful, IMAGES / f"replay_{tab.lower()}.png", tab=tab)
    screenshot([paper, plain], IMAGES / "replay_compare.png")


def draw_live(folder: Path, png: Path, at: int = 6000) -> None:
    """A viewer without a window in the middle of a run in real time, when `at` ticks are done."""
    from rerun.experimental import ViewerClient

    port, done = free_port(), 0
    address = data_address(port)

    def draw() -> None:
        png.write_bytes(ViewerClient.connect(address).take_screenshot())

    drawing = threading.Thread(target=draw)

    def progress(ticks: int) -> None:
        nonlocal done
        before, done = done, done + ticks
        if before < at <= done:
            drawing.start()

    with rerun("--headless", "--port", str(port), "--window-size", "1600x900") as viewer:
        viewer.wait_until(lambda: listens(port), "ready")
        with connected(address) as live:
            log = folder / "live.mcap"
            run_logged(load_scenario("paper"), log, real_time=True, progress=progress, live=live)
        drawing.join()


if __name__ == "__main__":
    main()
