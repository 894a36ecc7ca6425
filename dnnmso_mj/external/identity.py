"""Which code from outside a run depends on: digests of the files that it stands in."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterable
from importlib.metadata import entry_points
from pathlib import Path

from dnnmso_mj.importing import is_import_path
from dnnmso_mj.loading.trust import named_code
from dnnmso_mj.scenario import Scenario


def code_digests(scenarios: Iterable[Scenario]) -> dict[str, str]:
    """SHA-256 of the file behind each name in some scenarios that have been run here.

    N.B. of that file alone, not of what it imports.
    """
    names = {
        name for scenario in scenarios for _, name in named_code(scenario.model_dump(mode="json"))
    }
    files = {name: file for name in sorted(names) if (file := _file_of(name)) is not None}
    return {name: hashlib.sha256(file.read_bytes()).hexdigest() for name, file in files.items()}


def _file_of(name: str) -> Path | None:
    """Where the code is, of a module that is imported; None for one that has no file."""
    if is_import_path(name):
        where = name.rpartition(":")[0]
    else:
        points = [p for p in entry_points(name=name) if p.group.startswith("dnnmso_mj.")]
        where = points[0].module if points else ""
    file = where if where.endswith(".py") else getattr(sys.modules.get(where), "__file__", None)
    return Path(file) if file and Path(file).is_file() else None
