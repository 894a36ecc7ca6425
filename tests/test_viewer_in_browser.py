"""`dnnmso replay LOG --serve`, as a browser draws it."""

from __future__ import annotations

import io
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dnnmso_mj.loading import load_scenario
from dnnmso_mj.run import run_logged
from dnnmso_mj.viewer.process import free_port
from dnnmso_mj.viewer.signals import JOINT_COLORS
from tests.browser import chromium, needs_chromium

SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
PATIENCE = 90.0  # s; a quarter of it without anything else on the machine


@pytest.fixture
def address(tmp_path: Path) -> Iterator[str]:
    """Where the command says that it serves a log."""
    log = run_logged(
        load_scenario("paper", ["duration=2.0"], controller="pd"), tmp_path / "pd.mcap"
    ).log
    serve = ["replay", str(log), "--serve", "--port", str(free_port())]
    command = [sys.executable, "-m", "dnnmso_mj", *serve]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield process.stdout.readline().strip()
        process.terminate()


def near(image: np.ndarray, color: tuple[int, int, int]) -> int:
    """How many pixels have this colour, about."""
    return int((np.abs(image - np.array(color)).max(axis=-1) < 40).sum())


@needs_chromium
def test_the_browser_draws_the_arm_and_its_plots(address):
    with chromium(*SOFTWARE) as browser:
        page = browser.new_page(viewport={"width": 1000, "height": 700})
        page.goto(f"{address}&renderer=webgl")
        deadline, drawn = time.monotonic() + PATIENCE, False
        while not drawn and time.monotonic() < deadline:
            page.wait_for_timeout(500)
            shown = np.array(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)
            arm, plots = shown[:, :400], shown[:, 400:]
            drawn = all(
                near(arm, color) > 20 and near(plots, color) > 300 for color in JOINT_COLORS[:2]
            )
        assert drawn
