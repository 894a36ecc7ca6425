"""Draw the pictures of README and docs anew: `make figures`.

Runs the paper with and without its network, and keeps the figures and viewer screenshots of both.
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


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        logs = {}
        for name in ("paper", "paper_no_network"):
            run = run_logged(load_scenario(name), Path(folder) / f"{name}.mcap")
            save_figures(run.trace, Path(folder), name)
            logs[name] = run.log
        for kind in ("tracking", "error", "torque", "learning", "theory"):
            shutil.copy(Path(folder) / f"paper_{kind}.png", IMAGES / f"{kind}.png")
        plain = Path(folder) / "paper_no_network_tracking.png"
        shutil.copy(plain, IMAGES / "tracking_no_network.png")
        screenshot(logs["paper"], IMAGES / "replay_tracking.png")
        screenshot(logs["paper"], IMAGES / "replay_learning.png", tab="Learning")
        screenshot(logs["paper"], IMAGES / "replay_theory.png", tab="Theory")
        screenshot(logs["paper_no_network"], IMAGES / "replay_no_network.png", t=7.5)
        draw_live(Path(folder), IMAGES / "live.png")
    for image in sorted(IMAGES.glob("*.png")):
        print(image)


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
