"""Nothing in the package runs what data says: no eval, no pickle, no unsafe load, no shell."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

import dnnmso_mj

PACKAGE = Path(dnnmso_mj.__file__).parent
CONFIG = PACKAGE.parent / "pyproject.toml"

# exec, pickle, marshal, eval, XML with entities, unsafe YAML, shells, torch.load, banned names
RULES = "S102,S301,S302,S307,S314,S317,S318,S319,S506,S602,S604,S605,S609,TID251"

UNSAFE = {
    "eval": "eval(text)",
    "exec": "exec(text)",
    "pickle": "import pickle\npickle.loads(text)",
    "from pickle": "from pickle import loads",
    "marshal": "import marshal\nmarshal.loads(text)",
    "shelve": "import shelve",
    "dill": "import dill",
    "cloudpickle": "import cloudpickle",
    "joblib": "import joblib",
    "yaml": "import yaml\nyaml.load(text, Loader=yaml.Loader)",
    "torch": "import torch\ntorch.load(text, weights_only=False)",
    "pandas": "import pandas\npandas.read_pickle(text)",
    "shell": "import subprocess\nsubprocess.run(text, shell=True)",
    "system": "import os\nos.system(text)",
    "popen": "import os\nos.popen(text)",
    "getoutput": "import subprocess\nsubprocess.getoutput(text)",
    "runpy": "import runpy",
    "xml": "from xml.etree import ElementTree\nElementTree.fromstring(text)",
    "minidom": "from xml.dom import minidom",
    "lxml": "import lxml.etree",
    "numpy": "import numpy as np\nnp.load(text, allow_pickle=True)",
    "numpy by default": "import numpy as np\nnp.load(text)",
}


def found_by_ruff(paths: Sequence[Path]) -> list[str]:
    """What the rules find, excuses (`noqa`) not counted: "FILE:LINE: RULE"."""
    command = [sys.executable, "-m", "ruff", "check", "--no-cache", "--ignore-noqa", "--quiet"]
    options = ["--select", RULES, "--output-format", "json", "--config", str(CONFIG)]
    done = subprocess.run([*command, *options, *paths], capture_output=True, text=True, check=False)
    assert done.returncode in {0, 1}, done.stderr
    rows = json.loads(done.stdout)
    return [f"{Path(row['filename']).name}:{row['location']['row']}: {row['code']}" for row in rows]


def unpickling(text: str) -> list[int]:
    """Lines of calls of numpy's load that do not say allow_pickle=False."""
    calls = (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call))
    loads = (
        call
        for call in calls
        if isinstance(call.func, ast.Attribute)
        and call.func.attr == "load"
        and getattr(call.func.value, "id", "") in {"np", "numpy"}
    )
    return [
        call.lineno
        for call in loads
        if not any(
            word.arg == "allow_pickle"
            and isinstance(word.value, ast.Constant)
            and word.value.value is False
            for word in call.keywords
        )
    ]


@pytest.fixture(scope="module", autouse=True)
def _ruff() -> None:
    pytest.importorskip("ruff")
    if not CONFIG.exists():
        pytest.skip("the rules are in the source tree")


def test_the_package_runs_nothing_that_data_says() -> None:
    assert found_by_ruff([PACKAGE]) == []


def test_arrays_are_read_without_pickle() -> None:
    for path in PACKAGE.rglob("*.py"):
        assert unpickling(path.read_text(encoding="utf-8")) == [], path


@pytest.mark.parametrize("name", UNSAFE)
def test_the_rules_bite(name: str, tmp_path: Path) -> None:
    text = "text = input()\n" + UNSAFE[name].replace("\n", "  # noqa\n") + "  # noqa\n"
    sample = tmp_path / "sample.py"
    sample.write_text(text)
    assert found_by_ruff([sample]) or unpickling(text)
