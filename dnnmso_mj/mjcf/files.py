"""The files that an MJCF names: in its folder, regular, of known kinds and sizes.

What a header promises is held against the file's length before MuJoCo makes room for it.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath

import numpy as np

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.mjcf.png import pixels
from dnnmso_mj.mjcf.rules import MAX_HEIGHTS, MAX_NUMBER, MAX_PIXELS
from dnnmso_mj.mjcf.xml import MAX_BYTES, MAX_DEPTH, Tag, below, parse, refuse, walk
from dnnmso_mj.wording import clean

MAX_INCLUDES = 100
MAX_FILES_BYTES = 32 * 1024 * 1024  # of all files that a model names
MAX_FACES = 100_000  # of all meshes
MAX_HULL_FACES = 20_000  # the same, where the inertia is that of convex hulls

FOLDERS = {"mesh": "meshdir", "hfield": "meshdir", "texture": "texturedir"}
ALLOWED = "allowed: a file in the model's folder or below, named from there"

MAX_LINE = 1000  # characters of an OBJ's line
_ODD_VERTEX = re.compile(
    rb"^[ \t]*v[^\n]*?(nan|inf|e\+?0*[1-9]\d|(?<![.\d])\d{11})", re.IGNORECASE | re.MULTILINE
)


def read_file(path: Path) -> bytes:
    """An MJCF file.

    Raises:
        ScenarioError: it cannot be read, is not a regular file, or is too large.
    """
    name = clean(str(path))
    try:
        if not path.is_file():
            what = "not a regular file" if path.exists() else "no such file"
            raise ScenarioError(f"plant.model: cannot read {name}: {what}; allowed: an MJCF file")
        with path.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        what = getattr(error, "strerror", None) or str(error)
        raise ScenarioError(f"plant.model: cannot read {name}: {what}") from error
    return data


def put_in_includes(root: Tag, folder: Path) -> int:
    """Replace each <include file="…"/> by what stands in that file; the number of them.

    Args:
        folder: of the model, where all paths begin.

    Raises:
        ScenarioError: a file is outside the folder, is named twice, or there are too many.
    """
    sizes: dict[Path, int] = {}
    _include(root, folder, sizes, 1)
    return len(sizes)


def _include(parent: Tag, folder: Path, sizes: dict[Path, int], depth: int) -> None:
    if depth > MAX_DEPTH:
        raise refuse(parent, f"is nested too deeply; allowed: {MAX_DEPTH} levels")
    # From the last to the first, so that the places before stay what they are.
    for place, tag in reversed(list(enumerate(below(parent)))):
        if tag.tag != "include":
            _include(tag, folder, sizes, depth + 1)
            continue
        file = inside(tag, "file", folder)
        if file in sizes or len(sizes) >= MAX_INCLUDES:
            problem = f"is included again, or one too many; allowed: once, {MAX_INCLUDES} files"
            raise refuse(tag, problem, "file")
        data = read_file(file)
        sizes[file] = len(data)
        if sum(sizes.values()) > MAX_BYTES:
            raise refuse(tag, f"is too much; allowed: {MAX_BYTES} bytes of MJCF", "file")
        part = parse(data, tag.get("file", ""))
        if part.tag not in {"mujoco", "mujocoinclude"}:
            raise refuse(part, "is no part of an MJCF; allowed: <mujoco> or <mujocoinclude>")
        _include(part, folder, sizes, depth)
        parent[place : place + 1] = list(part)


def named(root: Tag) -> Iterator[tuple[Tag, str, str]]:
    """Every element that names a file, in which attribute, and its path from the model's folder."""
    settings: dict[str, str] = {}
    for compiler in walk(root, "compiler"):
        settings |= compiler.attrib
    shared = settings.get("assetdir", "")
    strips = settings.get("strippath") == "true"
    for tag in walk(root):
        if tag.tag not in FOLDERS:
            continue
        folder = settings.get(FOLDERS[tag.tag], shared)
        for key, path in tag.attrib.items():
            if key.startswith("file") and path:
                yield tag, key, str(Path(folder) / (Path(path).name if strips else path))


def check_files(root: Tag, folder: str) -> None:
    """Refuse files outside the folder, and those that MuJoCo would choke on.

    Raises:
        ScenarioError: the first that is found.
    """
    for compiler in walk(root, "compiler"):
        for key in ("assetdir", "meshdir", "texturedir"):
            if not _is_below(compiler.get(key, "")):
                raise refuse(compiler, "leads out of the model's folder; " + ALLOWED, key)
    convex = any(tag.get("inertia") == "convex" for tag in walk(root, "mesh"))
    most = {"mesh": MAX_HULL_FACES if convex else MAX_FACES, "texture": MAX_PIXELS}
    left = {**most, "hfield": MAX_HEIGHTS, "bytes": MAX_FILES_BYTES}
    for tag, key, path in named(root):
        if not folder:
            raise refuse(tag, "names a file; allowed: in a model that has a folder", key)
        file = inside(tag, key, Path(folder), path)
        try:
            left["bytes"] -= file.stat().st_size
            if left["bytes"] < 0:
                raise refuse(tag, f"is too large; allowed: {MAX_FILES_BYTES} bytes of all", key)
            left[tag.tag] -= _sized(tag, key, file)
        except OSError as error:
            raise refuse(tag, f"cannot be read: {error.strerror}; {ALLOWED}", key) from error
        if left[tag.tag] < 0:
            problem = f"has too many faces, pixels or heights; allowed: {most.get(tag.tag)} of all"
            raise refuse(tag, problem, key)


def _is_below(path: str) -> bool:
    """Whether a path is relative and goes down only."""
    parts = PurePosixPath(path).parts
    return not (path.startswith("/") or ".." in parts or set(path) & set("\\:\0"))


def inside(tag: Tag, key: str, folder: Path, path: str = "") -> Path:
    """The regular file that an attribute names."""
    given = tag.get(key, "")
    if not given or not _is_below(given) or not _is_below(path):
        raise refuse(tag, "leads out of the model's folder; " + ALLOWED, key)
    home = folder.resolve()
    try:
        file = (home / (path or given)).resolve()
        if not file.is_relative_to(home):
            raise refuse(tag, "is a link that leads out of the model's folder; " + ALLOWED, key)
        if not file.is_file():
            what = "not a regular file" if file.exists() else f"no such file in {clean(str(home))}"
            raise refuse(tag, f"{what}; {ALLOWED}", key)
    except (OSError, RuntimeError, ValueError) as error:
        raise refuse(tag, f"cannot be read: {clean(str(error))}; {ALLOWED}", key) from error
    return file


def _sized(tag: Tag, key: str, file: Path) -> int:
    """Faces, pixels or heights of a file, as its header says and its length bears out."""
    readers = READERS[tag.tag]
    reader = readers.get(file.suffix.lower())
    if reader is None:
        raise refuse(tag, f"is of no known kind; allowed: {', '.join(readers)}", key)
    size = reader(file.read_bytes())
    if size is None:
        problem = f"holds not what its header says, or no finite numbers; allowed: {file.suffix}"
        raise refuse(tag, problem, key)
    return size


def _finite(numbers: np.ndarray) -> bool:
    return bool((np.abs(numbers) <= MAX_NUMBER).all())


def _stl(data: bytes) -> int | None:
    count = struct.unpack_from("<I", data, 80)[0] if len(data) >= 84 else 0
    if not count or len(data) != 84 + 50 * count:
        return None
    rows = np.frombuffer(data, dtype=[("floats", "<f4", 12), ("rest", "<u2")], offset=84)
    return count if _finite(rows["floats"][:, 3:]) else None


def _obj(data: bytes) -> int | None:
    """Triangles, or lines where there are more than five for each."""
    data = data.replace(b"\r", b"\n")
    if data.count(b"\n") > 5 * MAX_FACES:
        return data.count(b"\n")
    lines = data.split(b"\n")
    if max(map(len, lines)) > MAX_LINE or _ODD_VERTEX.search(data):
        return None
    return sum(len(line.split()) - 3 for line in lines if line.lstrip()[:1] == b"f")


def _msh(data: bytes) -> int | None:
    if len(data) < 16:
        return None
    vertices, normals, texcoords, faces = struct.unpack_from("<4i", data)
    floats = 3 * vertices + 3 * normals + 2 * texcoords
    if min(vertices, normals, texcoords, faces) < 0 or len(data) != 16 + 4 * (floats + 3 * faces):
        return None
    inside = np.frombuffer(data, dtype="<i4", offset=16 + 4 * floats)
    numbers = np.frombuffer(data, dtype="<f4", count=floats, offset=16)
    if faces and not (inside.min() >= 0 and inside.max() < vertices):
        return None
    return max(faces, vertices) if _finite(numbers) else None


def _heights(data: bytes) -> int | None:
    rows, columns = struct.unpack_from("<2i", data) if len(data) >= 8 else (0, 0)
    if rows <= 0 or columns <= 0 or len(data) != 8 + 4 * rows * columns:
        return None
    return rows * columns if _finite(np.frombuffer(data, dtype="<f4", offset=8)) else None


Reader = Callable[[bytes], int | None]
READERS: dict[str, dict[str, Reader]] = {
    "mesh": {".stl": _stl, ".obj": _obj, ".msh": _msh},
    "texture": {".png": pixels},
    "hfield": {".png": pixels, ".bin": _heights},
}
