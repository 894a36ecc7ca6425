"""What software a run was made with: enough to install the same again."""

from __future__ import annotations

import functools
import platform
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

_PACKAGES = ("dnnmso_mj", "mujoco", "numpy", "scipy", "numba")
_WHERE_USED = ("torch",)  # a run may do without


def software_versions() -> dict[str, str]:
    """Versions of Python and of every package that numbers in a log depend on."""
    used = [name for name in _WHERE_USED if name in sys.modules]
    packages = {name: version(name) for name in (*_PACKAGES, *used)}
    return {"python": platform.python_version(), "platform": platform.platform(), **packages}


@functools.cache
def git_commit() -> str:
    """The commit of the checkout this package runs from, "-dirty" when changed; "" if none."""
    root = Path(__file__).resolve().parent.parent
    git = shutil.which("git")
    # An installed copy may lie inside someone else's repository, whose commit would say nothing.
    if not git or not (root / ".git").exists():
        return ""
    describe = ["describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    command = [git, "-C", str(root), *describe]  # no part of it comes from outside
    result = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    return result.stdout.strip() if result.returncode == 0 else ""
