"""What others are forked from imports this: all that a run needs, loaded and used once."""

from __future__ import annotations

import tempfile
from pathlib import Path

import dnnmso_mj.cli
import dnnmso_mj.plots
import dnnmso_mj.reading
import dnnmso_mj.resume
import dnnmso_mj.sweep.run  # noqa: F401
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.run import run_logged

with tempfile.TemporaryDirectory(prefix="dnnmso-ready-") as _folder:
    run_logged(load_scenario("paper", ["duration=0.05"]), Path(_folder) / "ready.mcap")
