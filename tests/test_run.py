"""A logged run: what its log holds at the end, however the run ends, and what it loads."""

from __future__ import annotations

import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from log_samples import LAYOUT, OK, recorder, rows
from mcap.reader import make_reader

from dnnmso_mj.errors import RunInterrupted
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.provenance import software_versions
from dnnmso_mj.reading import log_info, read_snapshots, read_trace
from dnnmso_mj.run import run_logged
from dnnmso_mj.scenario import Scenario


@pytest.fixture
def scenario(make_scenario: Callable[..., Scenario]) -> Scenario:
    return make_scenario(duration=1.5)


def test_a_log_holds_snapshots_a_second_apart_and_at_the_end(
    scenario: Scenario, tmp_path: Path
) -> None:
    done = run_logged(scenario, tmp_path / "run.mcap")
    snapshots = read_snapshots(done.log)
    for name in ("controller", "world"):
        assert [s.t for s in snapshots if s.name == name] == [0.0, 1.0, 1.5]
        first, later, last = (s.arrays for s in snapshots if s.name == name)
        assert first.keys() == later.keys() == last.keys()
        assert any((first[key] != later[key]).any() for key in first)
        assert any((later[key] != last[key]).any() for key in first)


def test_a_log_holds_the_wall_time_and_the_metrics_of_its_own_rows(
    scenario: Scenario, tmp_path: Path
) -> None:
    done = run_logged(scenario, tmp_path / "run.mcap")
    info = log_info(done.log)
    assert info.wall_s == done.trace.info.wall_s > 0.0
    assert info.metrics == done.trace.info.metrics == compute_metrics(read_trace(done.log))
    assert info.status == "ok"


def test_ctrl_c_leaves_a_whole_log_with_wall_time_and_metrics(
    scenario: Scenario, tmp_path: Path
) -> None:
    ran = 0

    def stop_after_a_while(ticks: int) -> None:
        nonlocal ran
        ran += ticks
        if ran >= 500:
            raise KeyboardInterrupt

    with pytest.raises(RunInterrupted) as stop:
        run_logged(scenario, tmp_path / "run.mcap", progress=stop_after_a_while)
    info = log_info(tmp_path / "run.mcap")
    assert (info.complete, info.status) == (True, "interrupted")
    assert info.ticks == stop.value.ticks == ran
    assert stop.value.log == tmp_path / "run.mcap"
    assert info.wall_s > 0.0
    assert info.metrics == compute_metrics(read_trace(tmp_path / "run.mcap"))
    assert info.metrics["rmse"] is not None


def test_a_diverged_run_leaves_the_state_it_ended_with(tmp_path: Path) -> None:
    done = run_logged(load_scenario("as_printed"), tmp_path / "run.mcap")
    assert done.trace.info.status == "diverged"
    assert log_info(done.log).metrics["diverged"] is True
    last = read_snapshots(done.log)[-1]
    assert last.t >= done.trace["t"][-1] > 0.0


def test_versions_are_those_of_what_numbers_depend_on() -> None:
    versions = software_versions()
    assert versions.keys() >= {"python", "platform", "dnnmso_mj", "mujoco", "numpy", "scipy"}
    assert versions["numpy"] == np.__version__
    assert ("torch" in versions) == ("torch" in sys.modules)


def test_the_recorded_library_is_this_version(scenario: Scenario, tmp_path: Path) -> None:
    done = run_logged(scenario, tmp_path / "run.mcap")
    with done.log.open("rb") as file:
        library = make_reader(file).get_header().library
    assert library == f"dnnmso_mj {software_versions()['dnnmso_mj']}"


@pytest.mark.parametrize(
    ("options", "absent"),
    [
        (["--no-plot"], {"torch", "rerun", "ray", "pyarrow", "matplotlib"}),
        ([], {"torch", "rerun", "ray", "pyarrow", "matplotlib.pyplot"}),
    ],
)
def test_a_run_loads_nothing_that_it_does_not_use(
    tmp_path: Path, options: list[str], absent: set[str]
) -> None:
    program = (
        "import sys\n"
        "from dnnmso_mj.cli import main\n"
        "try:\n    main()\n"
        "except SystemExit as end:\n    assert not end.code, end.code\n"
        f"assert not {absent} & set(sys.modules), {absent} & set(sys.modules)\n"
    )
    out = str(tmp_path / "run.mcap")
    command = ["run", "paper", "--set", "duration=0.1", "--out", out, *options]
    subprocess.run([sys.executable, "-c", program, *command], check=True, capture_output=True)


def test_a_long_log_is_in_memory_once(tmp_path: Path) -> None:
    data = rows(1000)
    with recorder(tmp_path / "run.mcap", duration=50.0) as log:
        for _ in range(50):
            log.append(data)
        log.finish(OK)
    tracemalloc.start()
    trace = read_trace(tmp_path / "run.mcap")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(trace) == 50_000
    assert peak < 1.3 * 8 * LAYOUT.width * len(trace)
