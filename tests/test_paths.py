"""Shipped files are found from a checkout, from any folder, and from an installed wheel."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from dnnmso_mj.errors import LogError, ScenarioError
from dnnmso_mj.paths import (
    find_log,
    find_model,
    find_scenario,
    logs_dir,
    model_name,
    models_dir,
    scenarios_dir,
)
from dnnmso_mj.reading import log_info, read_snapshots, read_trace, recover

REPOSITORY = Path(__file__).parents[1]


def test_a_checkout_has_models_and_scenarios_at_its_top() -> None:
    assert models_dir() == REPOSITORY / "models"
    assert scenarios_dir() == REPOSITORY / "scenarios"


def test_logs_go_under_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert logs_dir() == tmp_path / "logs"
    assert not logs_dir().exists()


@pytest.mark.parametrize("name", ["paper", "paper.yaml"])
def test_a_shipped_scenario_is_found_by_name_from_anywhere(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert find_scenario(name) == scenarios_dir() / "paper.yaml"


def test_a_file_comes_before_a_shipped_scenario_of_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("paper.yaml").write_text("name: mine\n")
    Path("paper").mkdir()
    assert find_scenario("paper.yaml") == Path("paper.yaml")
    assert find_scenario("paper") == scenarios_dir() / "paper.yaml"


@pytest.mark.parametrize("source", ["papr", "papr.yaml", "nowhere/papr.yaml"])
def test_an_unknown_scenario_is_refused_with_what_ships(source: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        find_scenario(source)
    message = str(caught.value)
    assert message.startswith(f"{source}: no such file; allowed: a YAML file, or one of ")
    assert "model_free, paper, paper_no_network" in message
    assert message.endswith("did you mean 'paper'?")


def test_what_is_not_a_regular_file_is_refused_unopened(tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    for source in (tmp_path, fifo, "/dev/zero"):
        with pytest.raises(ScenarioError, match="not a regular file"):
            find_scenario(source)


@pytest.mark.parametrize("source", ["", "a\0b", "x" * 5000, "\ud800"])
def test_impossible_file_names_are_refused(source: str) -> None:
    with pytest.raises(ScenarioError, match="allowed: "):
        find_scenario(source)
    with pytest.raises(ScenarioError, match="allowed: "):
        find_model(source)


@pytest.mark.parametrize("name", ["two_link", "two_link.xml"])
def test_a_shipped_model_is_found_by_name(name: str, tmp_path: Path) -> None:
    found = find_model(name, tmp_path)
    assert found == models_dir() / "two_link.xml"
    assert model_name(found) == "two_link"


def test_a_model_is_found_relative_to_its_scenario(tmp_path: Path) -> None:
    arm = tmp_path / "arms" / "arm.xml"
    arm.parent.mkdir()
    arm.write_text("<mujoco/>")
    found = find_model("arms/arm.xml", tmp_path)
    assert found == arm
    assert find_model(model_name(found), Path("/")) == arm


def test_a_file_called_like_a_shipped_model_needs_its_suffix(tmp_path: Path) -> None:
    for name in ("two_link", "two_link.xml"):
        (tmp_path / name).write_text("<mujoco/>")
    assert find_model("two_link", tmp_path) == models_dir() / "two_link.xml"
    assert find_model("two_link.xml", tmp_path) == tmp_path / "two_link.xml"


def test_an_unknown_model_is_refused_with_what_ships(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError) as caught:
        find_model("tow_link.xml", tmp_path)
    message = str(caught.value)
    assert message.startswith(f'no model "tow_link.xml" in {tmp_path}; allowed: an MJCF file, or ')
    assert "two_link" in message
    assert message.endswith("did you mean 'two_link'?")


IN_A_WHEEL = """
import pathlib, dnnmso_mj
from dnnmso_mj.loading import list_scenarios, load_scenario
from dnnmso_mj.paths import find_model, models_dir, scenarios_dir
home = pathlib.Path(dnnmso_mj.__file__).parent
print(home)
assert models_dir() == home / "data" / "models"
assert scenarios_dir() == home / "data" / "scenarios"
assert (scenarios_dir() / "scenario.schema.json").is_file()
assert find_model(load_scenario("paper").plant.model) == models_dir() / "two_link.xml"
print(" ".join(name for name, _ in list_scenarios()))
"""


def test_an_installed_wheel_finds_its_models_and_scenarios(tmp_path: Path) -> None:
    def run(*args: str, **more: str) -> str:
        done = subprocess.run(
            [sys.executable, *args],
            cwd=tmp_path,
            env={**os.environ, **more},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    dist, site = tmp_path / "dist", tmp_path / "site"
    run("-m", "build", "--wheel", "--no-isolation", "--outdir", str(dist), str(REPOSITORY))
    (wheel,) = dist.glob("*.whl")
    run("-m", "pip", "install", "--no-deps", "--no-index", "--target", str(site), str(wheel))
    home, names = run("-c", IN_A_WHEEL, PYTHONPATH=str(site)).splitlines()
    assert Path(home) == site / "dnnmso_mj"
    shipped = REPOSITORY / "scenarios"
    files = [*shipped.glob("*.yaml"), *(shipped / "literature").glob("*.yaml")]
    assert set(names.split()) == {str(p.relative_to(shipped).with_suffix("")) for p in files}


@pytest.fixture
def logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with logs of different ages, the current one."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "logs").mkdir()
    for age, name in enumerate(("paper", "paper-2", "push", "paper.v2")):
        log = tmp_path / "logs" / f"{name}.mcap"
        log.write_bytes(b"")
        os.utime(log, (age, age))
    return tmp_path


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("paper", "logs/paper.mcap"),  # that one, and not the newest of its scenario
        ("paper-2", "logs/paper-2.mcap"),
        ("paper.mcap", "logs/paper.mcap"),
        ("paper.v2", "logs/paper.v2.mcap"),
        ("last", "logs/paper.v2.mcap"),
        ("logs/push.mcap", "logs/push.mcap"),
        (Path("push"), "logs/push.mcap"),
    ],
)
def test_a_log_is_found_by_its_name_or_as_the_last(logs: Path, source: str, found: str) -> None:
    assert find_log(source) == Path(found)


def test_a_file_wins_over_a_name_and_a_name_over_a_folder(logs: Path) -> None:
    (logs / "push").mkdir()
    assert find_log("push") == Path("logs/push.mcap")
    (logs / "paper").write_bytes(b"")
    assert find_log("paper") == Path("paper")
    (logs / "logs" / "last.mcap").write_bytes(b"")
    os.utime(logs / "logs" / "last.mcap", (0, 0))
    assert find_log("last") == Path("logs/last.mcap")
    assert find_log("logs") == Path("logs")  # what reads it says that it is a folder


def test_an_unknown_log_is_refused_with_the_nearest_and_the_newest(logs: Path) -> None:
    with pytest.raises(LogError) as refused:
        find_log("pusch")
    assert str(refused.value) == (
        "pusch: no such log; allowed: a log file (.mcap), last, or one of logs, the newest first: "
        "paper.v2, push, paper-2, paper; did you mean 'push'?"
    )
    for log in (logs / "logs").iterdir():
        log.unlink()
    with pytest.raises(LogError, match="last: no such log, and none in logs; allowed: "):
        find_log("last")
    for number in range(20):
        (logs / "logs" / f"run-{number}.mcap").write_bytes(b"")
    with pytest.raises(LogError, match=r"(run-\d+, ){8}…$"):
        find_log("nothing")


def test_whatever_reads_logs_takes_their_names(logs: Path) -> None:
    for read in (read_trace, log_info, read_snapshots, lambda name: recover(name, "out.mcap")):
        with pytest.raises(LogError, match=r"logs/push\.mcap is empty"):
            read("push")
