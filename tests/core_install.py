"""No tests: an installation of the core alone, made of links to what is installed here.

A real virtual environment, in which there is nothing but what the core asks for, what that asks for
in turn, and this package's own metadata; its code is what the tests import, so that compiled loops
serve.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
import venv
from importlib.metadata import Distribution, distribution, requires
from pathlib import Path

from packaging.requirements import Requirement

from dnnmso_mj.paths import PACKAGE

ROOT = Path(__file__).parents[1]


def core_requirements() -> list[str]:
    """What pyproject.toml asks for without any extra."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return project["dependencies"]


def closure(texts: list[str]) -> dict[str, Distribution]:
    """The distributions that requirements bring, directly or not, by name."""
    found: dict[str, Distribution] = {}
    todo = [Requirement(text) for text in texts]
    while todo:
        item = todo.pop()
        name = item.name.lower().replace("_", "-").replace(".", "-")
        extras = ["", *item.extras]
        if name not in found:
            found[name] = distribution(item.name)
        for text in requires(item.name) or ():
            below = Requirement(text)
            if below.marker and not any(below.marker.evaluate({"extra": e}) for e in extras):
                continue
            if below.name.lower().replace("_", "-").replace(".", "-") not in found:
                todo.append(below)
    return found


def make_core(folder: Path) -> Path:
    """The interpreter of a new environment with the core alone."""
    venv.EnvBuilder(symlinks=True).create(folder)
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    site = folder / "lib" / version / "site-packages"
    for dist in closure(core_requirements()).values():
        tops = {Path(str(file)).parts[0] for file in dist.files or ()}
        for top in tops - {"..", "__pycache__", ""}:
            link = site / top
            if not link.exists():
                link.symlink_to(Path(str(dist.locate_file(top))).resolve())
    build = "import sys; from hatchling.build import prepare_metadata_for_build_wheel as make;"
    command = [sys.executable, "-c", f"{build} make(sys.argv[1])", str(site)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (site / "dnnmso_mj").symlink_to(PACKAGE)
    return folder / "bin" / "python"


def run_core(
    python: Path, *args: object, cwd: Path, module: str = "dnnmso_mj"
) -> subprocess.CompletedProcess[str]:
    """A command in that environment."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    return subprocess.run(
        [str(python), "-m", module, *map(str, args)],
        cwd=cwd,
        env=kept,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
