"""The gate that every MJCF passes before MuJoCo sees it, since a model may come from anywhere.

MuJoCo itself opens any path, copies a body as often as it is told, and lets a plugin in. So what is
given to it is written anew from what was checked here: elements and attributes alone, in UTF-8,
within the limits of `xml`, `rules` and `files`.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from dnnmso_mj.mjcf.files import check_files, named, put_in_includes, read_file
from dnnmso_mj.mjcf.rules import check_rules
from dnnmso_mj.mjcf.xml import Tag, parse

__all__ = ["Tag", "gate", "named", "parse", "read"]


def gate(text: str, folder: str = "") -> str:
    """Check an MJCF without includes.

    Args:
        text: the MJCF.
        folder: that the files which it names are in; without one it may name none.

    Returns:
        What MuJoCo may be given: the same elements, each on its line.

    Raises:
        ScenarioError: the place, the element, the attribute, its value, and what is allowed.
    """
    root = parse(text.encode("utf-8", "surrogatepass"), "the MJCF")
    return _checked(root, folder)


def read(path: Path) -> str:
    """The text of an MJCF file, what it includes put in its place.

    Raises:
        ScenarioError: as `gate`; or the file cannot be read.
    """
    data = read_file(path)
    root = parse(data, path.name)
    included = put_in_includes(root, path.parent)
    written = _checked(root, str(path.parent))
    return written if included else data.decode("utf-8-sig")


def _checked(root: Tag, folder: str) -> str:
    check_rules(root)
    check_files(root, folder)
    return "\n" * (root.line - 1) + ElementTree.tostring(root, encoding="unicode")
