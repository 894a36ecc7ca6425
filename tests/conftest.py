"""Shared fixtures: the shipped arm and scenarios made of few words."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import Scenario

ROOT = Path(__file__).parents[1]


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """Where DNNMSO_NO_SKIPS is set, a skipped test fails the run: nothing may be missing there."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if os.environ.get("DNNMSO_NO_SKIPS") and reporter.stats.get("skipped") and exitstatus == 0:
        reporter.write_line("skipped tests are not allowed with DNNMSO_NO_SKIPS", red=True)
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.fixture(scope="session", autouse=True)
def compiled_loop() -> None:
    """Compile once, so that no test of a command line sees the notice that it does.

    DNNMSO_SKIP_WARM_UP leaves it out, for a few tests of which each compiles what it needs.
    """
    if os.environ.get("DNNMSO_SKIP_WARM_UP"):
        return
    subprocess.run([sys.executable, ROOT / "tests" / "warm_up.py"], check=True)


@pytest.fixture(scope="session")
def two_link() -> Mjcf:
    return Mjcf.read(ROOT / "models" / "two_link.xml")


@pytest.fixture(scope="session")
def make_scenario() -> Callable[..., Scenario]:
    """A paper scenario with some parts replaced: make_scenario({"kind": ...}, duration=1.0)."""

    return _scenario


def _scenario(controller: dict[str, Any] | None = None, **parts: Any) -> Scenario:
    parts.setdefault("reference", {"kind": "sinusoid", "phase": [0.0, math.pi / 2]})
    return Scenario(name="test", controller=controller or {"kind": "dnn_mso"}, **parts)
