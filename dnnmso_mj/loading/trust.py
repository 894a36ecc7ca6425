"""Scenarios that run code: the keys `python`, where import paths begin, and who may use them.

An import path, "module:Name" or "file.py:Name", is refused unless the caller trusts the scenario.
The name of an entry point is not: somebody installed its package. TorchScript is refused alike,
since it is code that may open files; ONNX is not. Nothing is imported here.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.importing import is_import_path
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.scenario.policy import TORCHSCRIPT
from dnnmso_mj.wording import KeyPath, dotted, show

PYTHON = "python"  # every key of this name holds what is imported, wherever it stands,
FILE = "file"  # and one of this name a file

PROBLEM = (
    "runs code of its own; allowed: --trust (trust=True), if you know the scenario and that code"
)


def anchored(data: Any, folder: Path) -> Any:
    """A copy of some data in which every file that a key `python` or `file` names is absolute.

    Args:
        data: nested dicts, lists and values.
        folder: where relative paths begin.
    """
    if isinstance(data, dict):
        return {
            key: absolute(value, folder, key) if key in {PYTHON, FILE} else anchored(value, folder)
            for key, value in data.items()
        }
    return [anchored(item, folder) for item in data] if isinstance(data, list) else data


def absolute(name: Any, folder: Path, key: str = PYTHON) -> Any:
    """ "file.py:Name", or what `file` holds, with its absolute path; anything else as it is."""
    if key == FILE:
        return str(folder.absolute() / name) if name and isinstance(name, str) else name
    where, colon, attribute = name.rpartition(":") if isinstance(name, str) else ("", "", "")
    if not colon or not where.endswith(".py"):
        return name
    return f"{folder.absolute() / where}:{attribute}"


def named_code(data: Any, path: KeyPath = ()) -> Iterator[tuple[KeyPath, str]]:
    """Every name of code in some data, and the key path that holds it."""
    if isinstance(data, dict):
        for key, value in data.items():
            if key == PYTHON and isinstance(value, str):
                yield (*path, key), value
            else:
                yield from named_code(value, (*path, key))
    elif isinstance(data, list | tuple):
        for k, value in enumerate(data):
            yield from named_code(value, (*path, k))


def import_paths(data: Any) -> Iterator[tuple[KeyPath, str]]:
    """Every import path in some data, and its policy in TorchScript; with the key path of each."""
    yield from ((path, name) for path, name in named_code(data) if is_import_path(name))
    controller = data.get("controller") if isinstance(data, dict) else None
    file = controller.get(FILE) if isinstance(controller, dict) else None
    if isinstance(file, str) and Path(file).suffix in TORCHSCRIPT:
        yield ("controller", FILE), file


def require_trust(scenario: Scenario, where: str) -> None:
    """Refuse to run a scenario that came from elsewhere than `load_scenario`, as from a log.

    Args:
        scenario: what shall be run, by somebody who did not say that it is trusted.
        where: it came from, for the message.

    Raises:
        ScenarioError: it names code by import path, or a policy in TorchScript.
    """
    found = [
        f"{where}: {dotted(path)} = {show(value)}: {PROBLEM}"
        for path, value in import_paths(scenario.model_dump(mode="json"))
    ]
    if found:
        raise ScenarioError("\n".join(found))
