"""`dnnmso doctor`: on a sound machine, and on ones that lack something."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest
from core_install import make_core, run_core

from dnnmso_mj.doctor import Finding, document, examine, is_well, machine, packages, words
from dnnmso_mj.extras import EXTRAS


@pytest.fixture(scope="module")
def findings() -> dict[str, Finding]:
    return {finding.name: finding for finding in examine()}


def test_here_all_is_well_and_every_part_is_looked_at(findings):
    assert is_well(list(findings.values())), "\n".join(words(list(findings.values())))
    assert {finding.group for finding in findings.values()} == {
        "packages", "extras", "machine", "self-check"
    }  # fmt: skip
    assert findings["mujoco"] == Finding("packages", "mujoco", "ok", version("mujoco"))
    assert {name for name in EXTRAS if findings[name].state == "ok"} == set(EXTRAS)
    assert findings["a run repeated"].detail == "the same to the last bit"
    assert findings["cores"].detail.startswith(str(len(os.sched_getaffinity(0))))


def test_findings_as_text_have_what_to_do_at_once_below(findings):
    broken = Finding("machine", "clock", "broken", "stands still", "wind it up")
    lines = list(words([*findings.values(), broken]))
    at = next(k for k, line in enumerate(lines) if "BROKEN" in line)
    assert lines[at].split() == ["BROKEN", "clock", "stands", "still"]
    assert lines[at + 1].strip() == "→ wind it up"
    assert lines[-1] == "broken: clock"
    told = json.loads(document([*findings.values(), broken]))
    assert told["status"] == "broken"
    assert told["findings"][-1]["fix"] == "wind it up"


@pytest.fixture
def core(tmp_path) -> Path:
    return make_core(tmp_path / "core")


@pytest.mark.parametrize(
    ("lost", "named"),
    [(("mujoco",), "mujoco"), (("packaging",), "packaging"), (("numba", "llvmlite"), "numba")],
)
def test_it_survives_what_is_missing_and_says_how_to_get_it(lost, named, core, tmp_path):
    """In a real environment, from which a package has been taken away."""
    site = next((core.parents[1] / "lib").glob("*/site-packages"))
    for name in lost:
        for path in [*site.glob(f"{name}*"), *site.glob(f"{name.upper()}*")]:
            path.unlink() if path.is_symlink() else shutil.rmtree(path)
    done = run_core(core, "doctor", "--json", cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    found = {item["name"]: item for item in json.loads(done.stdout)["findings"]}
    assert found[named]["state"] == "broken"
    assert found[named]["fix"].startswith("pip install ")
    assert "not installed" in found[named]["detail"]


def test_without_the_command_line_library_the_module_answers(core, tmp_path):
    site = next((core.parents[1] / "lib").glob("*/site-packages"))
    for path in [*site.glob("typer*"), *site.glob("rich*")]:
        path.unlink()
    done = run_core(core, cwd=tmp_path, module="dnnmso_mj.doctor")
    assert done.returncode == 1
    lines = done.stdout.splitlines()
    assert "broken: rich, typer" in lines
    assert any(line.split()[:2] == ["BROKEN", "typer"] for line in lines)
    assert "Traceback" not in done.stderr


def test_versions_out_of_range_and_known_bad_pairs_are_broken(monkeypatch):
    """What importlib.metadata would say of other versions."""
    claimed = {"mujoco": "4.1.0", "numpy": "1.26.0"}

    def other(name: str) -> str:
        return claimed.get(name) or version(name)

    monkeypatch.setattr(packages, "version", other)
    found = {finding.name: finding for finding in packages.packages()}
    assert found["mujoco"].state == found["numpy"].state == "broken"
    assert found["mujoco"].detail == "4.1.0; allowed: <4,>=3.17"
    assert found["numpy"].fix == "pip install 'numpy>=2.0'"
    assert found["mujoco, dm-control"].fix == "pip install 'mujoco<4'"
    claimed["numpy"] = "99.0"  # in our range, and in none that numba allows itself
    found = {finding.name: finding for finding in packages.packages()}
    assert found["numpy"].state == "ok"
    assert "needs numpy" in found["numba"].detail.replace("which ", "")

    def absent(name: str) -> str:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(packages, "version", absent)
    with pytest.raises(PackageNotFoundError):
        list(packages.packages())  # `examine` tells of it


def test_a_machine_that_lacks_something_says_what_to_do(monkeypatch, tmp_path):
    nowhere = tmp_path / "file"
    nowhere.write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(nowhere / "below"))
    monkeypatch.setenv("VK_DRIVER_FILES", str(tmp_path / "none.json"))
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    found = {finding.name: finding for finding in machine.machine()}
    assert found["compiled code"].state == "broken"
    assert "NUMBA_CACHE_DIR" in found["compiled code"].fix
    assert found["Vulkan"].state == "missing"
    assert found["Vulkan"].fix == machine.VULKAN_FIX
    assert "--serve" in found["display"].fix
    assert found["browser"].fix == "apt-get install chromium"
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "made" / "when" / "needed"))
    found = {finding.name: finding for finding in machine.machine()}
    assert found["display"].state == found["compiled code"].state == "ok"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file"]


def test_a_self_check_that_dies_is_a_finding(monkeypatch):
    from dnnmso_mj.doctor import self_check

    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    (found,) = self_check.self_check()
    assert found.state == "broken"
    assert "NUMBA_DISABLE_JIT is set" in found.detail


def test_it_starts_without_importing_what_it_looks_at():
    program = (
        "import sys, dnnmso_mj.cli, dnnmso_mj.doctor.packages, dnnmso_mj.doctor.machine\n"
        "import dnnmso_mj.doctor.self_check\n"
        "print(sorted({'numpy', 'numba', 'mujoco', 'rich', 'ruamel'} & set(sys.modules)))"
    )
    shown = subprocess.check_output([sys.executable, "-c", program], text=True)
    assert shown.strip() == "[]"
