"""Which code this is: where the imported package lies, and a digest of all its sources."""

from __future__ import annotations

import functools
import hashlib
import os
import sys
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent


@functools.cache
def sources_digest(*marks: bytes) -> str:
    """SHA-256 over names and contents of the package's Python files, in the order of names.

    It tells apart what version numbers and a commit cannot: a changed checkout, a copy of one.

    Args:
        marks: only of files that hold one of these, if there are any.
    """
    digest = hashlib.sha256()
    names = {file.relative_to(PACKAGE).as_posix(): file for file in PACKAGE.rglob("*.py")}
    for name, file in sorted(names.items()):
        content = file.read_bytes()
        if not marks or any(mark in content for mark in marks):
            digest.update(f"{name}\0{len(content)}\0".encode() + content)
    return digest.hexdigest()


def python_path() -> str:
    """A PYTHONPATH by which another interpreter imports this very package, and all that we can."""
    before = os.environ.get("PYTHONPATH")
    ours = (entry or str(Path.cwd()) for entry in sys.path)
    entries = [str(PACKAGE.parent), *([before] if before else []), *ours]
    return os.pathsep.join(dict.fromkeys(entries))
