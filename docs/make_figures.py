"""Draw the pictures of README and docs anew: `make figures`.

Runs the paper with and without its network, and keeps the figures and viewer screenshots of both.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from dnnmso_mj.loading import load_scenario
from dnnmso_mj.plots import save_figures
from dnnmso_mj.replay import screenshot
from dnnmso_mj.run import run_logged

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
    for image in sorted(IMAGES.glob("*.png")):
        print(image)


if __name__ == "__main__":
    main()
