"""The files that an MJCF names, as meshes: kept in a log, and put back beside the model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree

from dnnmso_mj.plant import Mjcf

PREFIX = "asset/"  # of their attachments' names
FOLDERS = {"mesh": "meshdir", "hfield": "meshdir", "skin": "meshdir", "texture": "texturedir"}


def read_assets(mjcf: Mjcf) -> dict[str, bytes]:
    """The files that a model names, by the names of their attachments."""
    files = {}
    for _, _, path in _named(_root(mjcf.text)):
        file = Path(mjcf.folder) / path
        if file.is_file():
            files[PREFIX + path] = file.read_bytes()
    return files


def named_files(text: str, files: Mapping[str, bytes]) -> dict[str, bytes]:
    """Of a log's attachments, those that the MJCF `text` names."""
    names = [PREFIX + path for _, _, path in _named(_root(text))]
    return {name: files[name] for name in names if name in files}


def put_back(text: str, files: Mapping[str, bytes], folder: Path) -> Mjcf:
    """A model whose files are in a folder.

    Args:
        text: the MJCF.
        files: attachments, by name.
        folder: where to write those that the model names; it must live as long as the model is
            built from.
    """
    root = _root(text)
    found = False
    for number, (element, key, path) in enumerate(list(_named(root))):
        data = files.get(PREFIX + path)
        if data is not None:
            file = folder.resolve() / str(number) / Path(path).name  # which may name the element
            file.parent.mkdir(exist_ok=True)
            file.write_bytes(data)
            element.set(key, str(file))
            found = True
    if not found:
        return Mjcf(text)
    for compiler in root.iter("compiler"):
        compiler.set("strippath", "false")
    return Mjcf(ElementTree.tostring(root, encoding="unicode"))


def _root(text: str) -> ElementTree.Element:
    try:
        return ElementTree.fromstring(text)  # noqa: S314
    except ElementTree.ParseError:  # MuJoCo takes more than is XML; of that, no files are kept
        return ElementTree.Element("mujoco")


def _named(root: ElementTree.Element) -> Iterator[tuple[ElementTree.Element, str, str]]:
    """Every element that names a file, in which attribute, and its path from the model's folder."""
    settings: dict[str, str] = {}
    for compiler in root.iter("compiler"):
        settings |= compiler.attrib
    shared = settings.get("assetdir", "")
    strips = settings.get("strippath") == "true"
    for element in root.iter():
        if element.tag not in FOLDERS:
            continue
        folder = settings.get(FOLDERS[element.tag], shared)
        for key, path in element.attrib.items():
            if key.startswith("file") and path:
                yield element, key, str(Path(folder) / (Path(path).name if strips else path))
