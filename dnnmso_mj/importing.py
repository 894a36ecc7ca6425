"""Python objects that a scenario names: by import path, or by entry point of an installed package.

    package.module:Name      an importable module's
    folder/file.py:Name      a file's
    name                     an entry point's, of a group such as "dnnmso_mj.controllers"

An entry point is there because somebody installed its package; an import path is any code that a
scenario asks for. So the loader refuses import paths unless it is told to trust them; here nothing
is refused any more.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from importlib.metadata import EntryPoints, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.wording import did_you_mean, show


def is_import_path(name: str) -> bool:
    """Whether a name says where code is, rather than which entry point it is."""
    return ":" in name


def import_named(name: str, key: str, group: str) -> Any:
    """The object that a scenario names.

    Args:
        name: "package.module:Name", "/folder/file.py:Name", or an entry point's name.
        key: the key path that holds it, for messages.
        group: of entry points, e.g. "dnnmso_mj.controllers".

    Raises:
        ScenarioError: there is no such module, file, name in it, or entry point; or its import
            failed, with the reason.
    """
    if not is_import_path(name):
        return _entry_point(name, key, group)
    where, _, attribute = name.rpartition(":")
    try:
        found: Any = _file(Path(where)) if where.endswith(".py") else importlib.import_module(where)
    except Exception as error:  # whatever foreign code raises
        raise ScenarioError(
            f"{key} = {show(name)} cannot be imported: {type(error).__name__}: {error}; allowed: "
            "module:Name of a module that Python finds, or file.py:Name"
        ) from error
    for part in attribute.split("."):
        names = [word for word in dir(found) if not word.startswith("_")]
        if not hasattr(found, part):
            has = f"it has {', '.join(names[:20])}" if names else "it has none"
            hint = did_you_mean(part, names)
            raise ScenarioError(f"{key} = {show(name)}: no name {show(part)} there; {has}{hint}")
        found = getattr(found, part)
    return found


def installed(group: str) -> EntryPoints:
    """The entry points of a group, of all installed packages."""
    return entry_points(group=group)


def _entry_point(name: str, key: str, group: str) -> Any:
    found = installed(group)
    if name not in found.names:
        names = sorted(found.names)
        has = f"installed: {', '.join(names)}" if names else "none is installed"
        raise ScenarioError(
            f"{key} = {show(name)}: no entry point of the group {group} ({has}); allowed: one of "
            f"those, module:Name, or file.py:Name{did_you_mean(name, names)}"
        )
    try:
        return found[name].load()
    except Exception as error:  # whatever foreign code raises
        raise ScenarioError(
            f"{key} = {show(name)}: its entry point {found[name].value} cannot be imported: "
            f"{type(error).__name__}: {error}"
        ) from error


def _file(path: Path) -> ModuleType:
    """The module in a file, imported once a process."""
    name = f"dnnmso_mj_file_{path.resolve().as_posix()}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"no Python file {path}")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module
