"""What a real bash offers at <TAB>, and how soon."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import re
import resource
import select
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import pytest

from dnnmso_mj.cli.completing import complete_set
from dnnmso_mj.loading import controller_kinds, scenario_schema
from dnnmso_mj.paths import scenario_names, shipped_controllers

BIN = Path(sys.executable).parent
HEAVY = {
    "numpy",
    "scipy",
    "numba",
    "mujoco",
    "ruamel",
    "rich",
    "matplotlib",
    "pyarrow",
    "torch",
    "rerun",
}


@pytest.fixture(scope="module")
def workplace(tmp_path_factory) -> Path:
    """A folder with two logs, a scenario and the script that bash reads."""
    folder = tmp_path_factory.mktemp("tab")
    (folder / "logs").mkdir()
    for age, name in enumerate(("old_one", "new_one")):
        log = folder / "logs" / f"{name}.mcap"
        log.write_bytes(b"")
        os.utime(log, (age, age))
    (folder / "paper_mine.yaml").write_text("name: mine\n")
    script = subprocess.check_output([BIN / "dnnmso", "completion", "bash"], text=True)
    (folder / "complete.sh").write_text(script)
    return folder


def asked(line: str, folder: Path) -> list[str]:
    """What the completion function of bash answers to a line with the cursor at its end."""
    program = (
        "source complete.sh; COMP_LINE=$1; COMP_POINT=${#1}; _dnnmso_completion dnnmso;"
        'printf "%s\\n" "${COMPREPLY[@]}"'
    )
    path = {"PATH": f"{BIN}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "--norc", "-c", program, "bash", line],
        cwd=folder,
        env=os.environ | path,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    return done.stdout.split()


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("dnnmso sc", ["scenarios", "schema"]),
        ("dnnmso run paper_n", ["paper_no_network"]),
        ("dnnmso run paper_", ["paper_no_network", "paper_mine.yaml"]),
        ("dnnmso info ", ["new_one", "old_one", "last", "logs/"]),
        ("dnnmso replay last --t", ["--tab"]),
        ("dnnmso compare paper --controllers pd,pi", ["pd,pid", "pd,pid_tuned"]),
        ("dnnmso tune paper --controller l1", ["l1", "l1_constant_tuned", "l1_tuned"]),
        ("dnnmso run paper --set plant.g", ["plant.gravity="]),
        ("dnnmso run paper --set pla", ["plant."]),
        ("dnnmso run paper --set controller.madam.be", ["controller.madam.beta="]),
        ("dnnmso run paper --set plant.links=", ["point_mass", "rod"]),
        ("dnnmso run --set controller.observer.feedback=s", ["stable"]),
        ("dnnmso run paper --set controller.kind=pd --set controller.k", ["kind=", "kp=", "kd="]),
        ("dnnmso run paper --set events.0.at", ["events.0.at="]),
        ("dnnmso new mine --controller rbf_mso_", ["rbf_mso_tuned"]),
        ("dnnmso completion f", ["fish"]),
        ("dnnmso run nothing_begins_so", []),
    ],
)
def test_bash_is_offered(line, offered, workplace):
    found = asked(line, workplace)
    if "controller.k" in line:
        found = [word.removeprefix("controller.") for word in found]
    assert sorted(found) == sorted(offered)


def test_a_tab_in_an_interactive_bash_writes_the_word_to_its_end(workplace):
    """Where more is to be typed, no space follows; else one does."""
    parent, child = pty.openpty()
    fcntl.ioctl(child, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 200, 0, 0))
    env = os.environ | {"PATH": f"{BIN}:{os.environ['PATH']}", "PS1": "ready> ", "TERM": "dumb"}
    shell = subprocess.Popen(
        ["bash", "--norc", "-i"], cwd=workplace, env=env, stdin=child, stdout=child, stderr=child
    )
    os.close(child)
    try:
        read_until(parent, "ready> ")
        os.write(parent, b"source complete.sh\n")
        read_until(parent, "ready> ")
        os.write(parent, b"dnnmso run paper_no\t--set plant.gr\t1.62 --set plant.li\tr\t")
        shown = read_until(parent, "=rod")
    finally:
        shell.kill()
        shell.wait()
        os.close(parent)
    assert "dnnmso run paper_no_network --set plant.gravity=1.62 --set plant.links=rod" in shown


def read_until(terminal: int, word: str, seconds: float = 60.0) -> str:
    shown, end = "", time.monotonic() + seconds
    while word not in shown:
        ready, _, _ = select.select([terminal], [], [], max(0.0, end - time.monotonic()))
        assert ready, f"no {word!r} in {shown!r}"
        shown += os.read(terminal, 65536).decode()
        shown = re.sub(r"\x1b\[[?0-9;]*[a-zA-Z]|\a", "", shown)
    return shown


def test_zsh_and_fish_get_scripts_and_answers(workplace):
    for shell in ("zsh", "fish"):
        script = subprocess.check_output([BIN / "dnnmso", "completion", shell], text=True)
        assert "_DNNMSO_COMPLETE=complete_" + shell in script
    zsh = {"_DNNMSO_COMPLETE": "complete_zsh", "_TYPER_COMPLETE_ARGS": "dnnmso run paper_n"}
    answer = subprocess.check_output(
        [BIN / "dnnmso"], cwd=workplace, env=os.environ | zsh, text=True
    )
    assert '"paper_no_network"' in answer


def test_a_tab_imports_nothing_heavy(workplace):
    program = (
        "import sys\n"
        "from dnnmso_mj.cli import main\n"
        "try:\n    main()\n"
        "finally:\n    import json; json.dump(sorted(sys.modules), open('modules.json', 'w'))\n"
    )
    env = os.environ | {
        "_DNNMSO_COMPLETE": "complete_fish",
        "_TYPER_COMPLETE_FISH_ACTION": "get-args",
        "_TYPER_COMPLETE_ARGS": "dnnmso run paper --set controller.madam.e",
    }
    command = [sys.executable, "-c", program]
    shown = subprocess.check_output(command, cwd=workplace, env=env, text=True)
    assert shown.split() == ["controller.madam.eta=", "controller.madam.eta_max="]
    loaded = set(json.loads((workplace / "modules.json").read_text()))
    assert HEAVY & loaded == set()


def test_a_tab_takes_less_than_half_a_second(workplace):
    """Of the processor, bash included, so that what else runs here does not count."""
    took = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        asked("dnnmso run paper --set controller.network.", workplace)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        took.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    assert min(took) < 0.5


class Line:
    """A command line as typer has it while it is completed."""

    def __init__(self, scenario: str) -> None:
        self.params = {"scenario": scenario, "overrides": None}


def test_every_key_of_every_kind_can_be_reached():
    """Walked down from the root, the keys offered are those of the schema, no more and no fewer."""
    definitions = scenario_schema()["$defs"]
    leaves, todo = set(), [""]
    while todo:
        for word in complete_set(Line("nowhere"), todo.pop()):
            (todo.append if word.endswith(".") else leaves.add)(word)
    for name in ("DnnMso", "Pd", "LewisNn", "Adrc"):
        for key, part in definitions[name]["properties"].items():
            group = "$ref" in part or "discriminator" in part
            assert group or f"controller.{key}=" in leaves
    assert {"seed=", "plant.masses=", "imperfections.friction.coulomb="} <= leaves


def test_names_are_those_that_ship(workplace):
    assert set(scenario_names()) <= set(asked("dnnmso run ", workplace))
    offered = set(asked("dnnmso new mine --controller ", workplace))
    assert {*controller_kinds(), *shipped_controllers()} <= offered
