"""Shared fixtures: the shipped arm and scenarios made of few words; how tests share the machine."""

from __future__ import annotations

import fcntl
import math
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import Scenario

ROOT = Path(__file__).parents[1]
LOCKS = "DNNMSO_TEST_LOCKS"

# Started in a shell's background all programs would ignore the Ctrl-C that tests send them.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Workers share the cores: torch's threads would wait for one another.
os.environ.setdefault("OMP_NUM_THREADS", "1")


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile once, before workers start: no test of a command line sees the notice that it does.

    DNNMSO_SKIP_WARM_UP leaves it out, for a few tests of which each compiles what it needs.
    """
    if _is_worker(session.config):
        return
    os.environ[LOCKS] = tempfile.mkdtemp(prefix="dnnmso-tests-")
    if not (os.environ.get("DNNMSO_SKIP_WARM_UP") or session.config.option.collectonly):
        subprocess.run([sys.executable, ROOT / "tests" / "warm_up.py"], check=True)


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """Where DNNMSO_NO_SKIPS is set, a skipped test fails the run: nothing may be missing there."""
    if _is_worker(session.config):
        return
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if os.environ.get("DNNMSO_NO_SKIPS") and reporter.stats.get("skipped") and exitstatus == 0:
        reporter.write_line("skipped tests are not allowed with DNNMSO_NO_SKIPS", red=True)
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What runs alone first, while there is nothing long to wait for; then the other rows of the
    scorecard: each takes long, and no worker shall end alone with one.
    """
    alone = {item.path for item in items if item.get_closest_marker("alone")}
    items.sort(
        key=lambda item: (item.path not in alone, not item.path.name.startswith("test_soak"))
    )


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Tests run beside those of other workers, but for those marked `alone`."""
    alone = item.get_closest_marker("alone") is not None
    how = fcntl.LOCK_EX if alone else fcntl.LOCK_SH
    with _locked("turn", fcntl.LOCK_EX) as turn, _locked("machine", how):
        # Whoever waits to be alone keeps the turn, so that no other test begins meanwhile.
        if not alone:
            fcntl.flock(turn, fcntl.LOCK_UN)
        return (yield)


@contextmanager
def _locked(name: str, how: int) -> Iterator[int]:
    handle = os.open(Path(os.environ[LOCKS]) / name, os.O_CREAT | os.O_RDWR)
    try:
        fcntl.flock(handle, how)
        yield handle
    finally:
        fcntl.flock(handle, fcntl.LOCK_UN)  # for forked processes too, which hold it as well
        os.close(handle)


def _is_worker(config: pytest.Config) -> bool:
    return hasattr(config, "workerinput")


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
