"""Which files a scenario may name: those in reach of the file that names them.

In reach is what is in that file's folder or below, or in the current folder or below, links
followed; and what ships with this package or an installed one, which is named and not pathed. What
the command line names, itself or in a `--set`, is named by the user, and so in reach anywhere.
`--trust` lets a scenario name any file.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dnnmso_mj.loading.complaints import Complaint, complain
from dnnmso_mj.loading.places import Places
from dnnmso_mj.loading.trust import FILE
from dnnmso_mj.wording import KeyPath, clean

PROBLEM = (
    "is out of reach; allowed: files in {} or below, or in the current folder or below; any other "
    "by --set, or with --trust (trust=True), if you know the scenario"
)


def in_reach(file: Path, home: Path) -> bool:
    """Whether a file, links followed, is in the folder `home`, the current folder, or below."""
    try:
        real = file.resolve()
        return any(real.is_relative_to(folder.resolve()) for folder in (home, Path.cwd()))
    except (OSError, RuntimeError, ValueError):  # a name too long, links in a circle, a NUL
        return False


def refused(path: KeyPath, data: Any, home: Path) -> Complaint:
    """The complaint about a file that is out of reach."""
    return complain(path, data, PROBLEM.format(clean(str(home))))


def out_of_reach(data: Any, places: Places) -> list[Complaint]:
    """Complaints about the keys `file` of a scenario whose files are out of reach."""
    found = []
    for path, name in named_files(data):
        home = places.home(path)
        if home is not None and not in_reach(home / name, home):
            found.append(refused(path, data, home))
    return found


def named_files(data: Any, path: KeyPath = ()) -> Iterator[tuple[KeyPath, str]]:
    """Every file that a key `file` names, and the key path that holds it."""
    if isinstance(data, dict):
        for key, value in data.items():
            if key == FILE and isinstance(value, str):
                yield (*path, key), value
            else:
                yield from named_files(value, (*path, key))
    elif isinstance(data, list):
        for k, value in enumerate(data):
            yield from named_files(value, (*path, k))
