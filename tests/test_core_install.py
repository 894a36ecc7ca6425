"""The core alone, in an environment of its own: what runs there, and what names its extra."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from core_install import make_core, run_core
from typer.main import get_command

from dnnmso_mj.cli import app
from dnnmso_mj.extras import EXTRAS, pip_install

RUNS = {
    "run": ("run", "paper_no_network", "--set", "duration=0.1"),
    "info": ("info", "last"),
    "recover": ("recover", "last", "--out", "whole.mcap"),
    "resume": ("resume", "last", "--at", "0.05", "--out", "resumed.mcap", "--no-plot"),
    "diff": ("diff", "last", "last"),
    "check": ("check", "--states", "10"),
    "schema": ("schema",),
    "scenarios": ("scenarios",),
    "controllers": ("controllers",),
    "new": ("new", "mine"),
    "completion": ("completion", "bash"),
}
NEEDS = {
    "sweep": (("sweep", "paper", "--seeds", "0:2"), "sweep"),
    "compare": (("compare", "paper", "--controllers", "pd,pid", "--seeds", "0"), "sweep"),
    "margins": (("margins", "paper", "--controllers", "pd", "--seeds", "0"), "sweep"),
    "tune": (
        (
            "tune",
            "tuning",
            "--controller",
            "pd",
            "--trials",
            "2",
            "--seeds",
            "0",
            "--out",
            "o.yaml",
        ),
        "tune",
    ),
    "report": (("report", "a.parquet"), "report"),
    "audit": (("audit", "paper", "--at", "0.1", "--seeds", "0"), "plot"),
    "plot": (("plot", "last"), "plot"),
    "replay": (("replay", "last", "--save", "x.rrd"), "viewer"),
    "bench": (("bench", "step", "--quick"), "sweep"),
}


@pytest.fixture(scope="module")
def core(tmp_path_factory) -> Path:
    return make_core(tmp_path_factory.mktemp("core"))


@pytest.fixture(scope="module")
def workplace(core, tmp_path_factory) -> Path:
    """A folder with a log, made by the core."""
    folder = tmp_path_factory.mktemp("work")
    done = run_core(core, *RUNS["run"], cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "rmse_steady" in done.stdout
    assert done.stderr == (
        "no figures: drawing them needs matplotlib and pillow, which are not installed: "
        "pip install 'dnnmso_mj[plot]' (--no-plot: without this line)\n"
    )
    return folder


def test_every_command_is_tried_here():
    assert RUNS.keys() | NEEDS.keys() | {"doctor"} == get_command(app).commands.keys()


@pytest.mark.parametrize("name", RUNS)
def test_what_needs_no_extra_runs(name, core, workplace):
    done = run_core(core, *RUNS[name], cwd=workplace)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout


@pytest.mark.parametrize("name", NEEDS)
def test_what_needs_an_extra_names_it_before_it_does_anything(name, core, workplace):
    args, extra = NEEDS[name]
    before = sorted(workplace.rglob("*"))
    done = run_core(core, *args, cwd=workplace)
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: dnnmso {name} needs ")
    assert done.stderr.endswith(f"not installed: {pip_install(extra)}\n")
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""
    assert sorted(workplace.rglob("*")) == before


def test_the_core_has_no_part_of_any_extra(core, workplace):
    modules = sorted({module for extra in EXTRAS.values() for module in extra.modules.values()})
    looked = "import importlib.util as u, sys; print([n for n in sys.argv[1:] if u.find_spec(n)])"
    script = workplace / "looked.py"
    script.write_text(looked)
    done = run_core(core, *modules, cwd=workplace, module="looked")
    script.unlink()
    assert done.stdout.strip() == "[]", done.stderr


def test_the_doctor_calls_the_core_well_and_names_every_extra(core, workplace):
    done = run_core(core, "doctor", "--json", cwd=workplace)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout)
    assert found["status"] == "ok"
    told = {item["name"]: item for item in found["findings"] if item["group"] == "extras"}
    assert told.keys() == EXTRAS.keys()
    for name, item in told.items():
        assert item["state"] == "missing"
        assert item["fix"] == pip_install(name)
