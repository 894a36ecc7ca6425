"""What is installed: in the environment that runs this, or in another."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import venv
from importlib.metadata import distributions
from pathlib import Path

from packaging.utils import canonicalize_name

# Variables that would let a tree be imported which is not installed, or an install miss the lock.
LEFT_OUT = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "MAKEFLAGS", "MAKELEVEL")
LIST = """
import json
from importlib.metadata import distributions
print(json.dumps({d.metadata["Name"]: d.version for d in distributions()}))
"""


def clean_environment() -> dict[str, str]:
    """The variables of this process, without those that lead back to it."""
    return {name: value for name, value in os.environ.items() if name not in LEFT_OUT}


def versions(python: Path = Path(sys.executable)) -> dict[str, str]:
    """Version of every distribution that an interpreter sees, by name, without a local label."""
    command = [str(python), "-c", LIST]
    done = subprocess.run(
        command, env=clean_environment(), cwd="/", check=True, capture_output=True, text=True
    )
    found = json.loads(done.stdout).items()
    return {canonicalize_name(name): version.partition("+")[0] for name, version in found}


def overlay(folder: Path, wheel: Path) -> Path:
    """The interpreter of a new environment: a wheel in it, all else seen from this one's.

    A line in a .pth file adds a folder, not what its own .pth files add: our checkout is not there.
    """
    venv.EnvBuilder(symlinks=True, with_pip=False).create(folder)
    (site,) = (folder / "lib").glob("python*/site-packages")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    command += ["--disable-pip-version-check", "--target", str(site), str(wheel)]
    subprocess.run(command, check=True, capture_output=True)
    seen = {str(Path(str(one.locate_file("."))).resolve()) for one in distributions()}
    here = [path for path in seen if path.endswith("site-packages")]
    (site / "seen.pth").write_text("".join(f"{path}\n" for path in here), encoding="utf-8")
    return folder / "bin" / "python"
