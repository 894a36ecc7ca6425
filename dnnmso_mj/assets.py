"""The files that an MJCF names, as meshes: kept in a log, and put back beside the model."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.mjcf import Tag, named, parse
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.wording import show

PREFIX = "asset/"  # of their attachments' names
LONGEST_NAME = 200  # bytes


def read_assets(mjcf: Mjcf) -> dict[str, bytes]:
    """The files that a model names, by the names of their attachments."""
    files = {}
    for _, _, path in named(_root(mjcf.text)):
        file = Path(mjcf.folder) / path
        if file.is_file():
            files[PREFIX + path] = file.read_bytes()
    return files


def named_files(text: str, files: Mapping[str, bytes]) -> dict[str, bytes]:
    """Of a log's attachments, those that the MJCF `text` names."""
    names = [PREFIX + path for _, _, path in named(_root(text))]
    return {name: files[name] for name in names if name in files}


def put_back(text: str, files: Mapping[str, bytes], folder: Path) -> Mjcf:
    """A model whose files are in a folder.

    Args:
        text: the MJCF.
        files: attachments, by name.
        folder: where to write those that the model names; it must live as long as the model is
            built from.

    Raises:
        ScenarioError: a file's name can be none in a folder, or the model is refused.
    """
    root = _root(text)
    numbers: dict[str, int] = {}  # a file is written once, however often it is named
    for element, key, path in list(named(root)):
        data = files.get(PREFIX + path)
        if data is not None:
            number = numbers.setdefault(path, len(numbers))
            name = f"{number}/{_file_name(path)}"  # which may name the element
            file = folder / name
            if not file.exists():
                file.parent.mkdir()
                file.write_bytes(data)
            element.set(key, name)
    if not any(folder.iterdir()):
        return Mjcf(text)
    for compiler in root.iter("compiler"):
        for key in ("assetdir", "meshdir", "texturedir", "strippath"):
            compiler.attrib.pop(key, None)
    return Mjcf(ElementTree.tostring(root, encoding="unicode"), str(folder.resolve()))


def _file_name(path: str) -> str:
    """The last part of a path, if it is the name of a file and of nothing else."""
    name = Path(path).name
    if name in {"", ".", ".."} or not name.isprintable() or len(name.encode()) > LONGEST_NAME:
        raise ScenarioError(
            f"plant.model: the MJCF of a log names the file {show(path)}; allowed: the name of a "
            f"file, of at most {LONGEST_NAME} bytes"
        )
    return name


def _root(text: str) -> Tag:
    return parse(text.encode("utf-8", "surrogatepass"), "the MJCF of a log")
