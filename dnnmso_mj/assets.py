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
        ScenarioError: a file cannot be written, or `dnnmso_mj.mjcf.gate` refuses the model.
    """
    root = _root(text)
    numbers: dict[str, int] = {}  # a file is written once, however often it is named
    for element, key, path in list(named(root)):
        data = files.get(PREFIX + path)
        name = f"{numbers.setdefault(path, len(numbers))}/{Path(path).name}"  # of the element, too
        if data is not None and Path(name).name != "..":
            _write(folder / name, data)
            element.set(key, name)
    if not any(folder.iterdir()):
        return Mjcf(text)
    for compiler in root.iter("compiler"):
        for key in ("assetdir", "meshdir", "texturedir", "strippath"):
            compiler.attrib.pop(key, None)
    return Mjcf(ElementTree.tostring(root, encoding="unicode"), str(folder.resolve()))


def _write(file: Path, data: bytes) -> None:
    try:
        file.parent.mkdir(exist_ok=True)
        if not file.exists():
            file.write_bytes(data)
    except (OSError, ValueError) as error:
        raise ScenarioError(f"plant.model: its file {show(file.name)}: {error}") from error


def _root(text: str) -> Tag:
    return parse(text.encode("utf-8", "surrogatepass"), "the MJCF of a log")
