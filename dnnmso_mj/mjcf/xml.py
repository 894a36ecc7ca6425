"""Elements and attributes of an XML text from anywhere, each with its place; nothing is expanded.

Comments, texts and processing instructions are left out; declarations of types and entities are
refused. Lines stay what they are, so that messages of MuJoCo name those of the file.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, cast
from xml.etree import ElementTree
from xml.parsers import expat

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.wording import clean, show

MAX_BYTES = 2 * 1024 * 1024  # of an MJCF, its includes counted
MAX_DEPTH = 200
MAX_ELEMENTS = 5000  # as they are written; `rules` counts copies too
MAX_ATTRIBUTES = 100  # of an element
MAX_WORD = 512  # characters between two spaces of an attribute

SPACES = re.compile(r"[\t\n\r]")


class Tag(ElementTree.Element):
    """An element that knows where it stands: "arm.xml:12"."""

    place: str = ""
    line: int = 1


def walk(root: Tag, name: str | None = None) -> Iterator[Tag]:
    """An element and all below it, or those of a name, in the order of the text."""
    return cast("Iterator[Tag]", root.iter(name))


def below(tag: Tag) -> list[Tag]:
    """The elements that stand in an element."""
    return cast("list[Tag]", list(tag))


def refuse(tag: Tag, problem: str, key: str = "") -> ScenarioError:
    """The error for an element, or for its attribute `key`."""
    value = f" {key} = {show(tag.get(key))}" if key else ""
    return ScenarioError(f"plant.model: {tag.place}: <{clean(tag.tag)}>{value}: {problem}")


def parse(data: bytes, name: str) -> Tag:
    """Read an XML text.

    Args:
        data: UTF-8.
        name: how messages call it.

    Raises:
        ScenarioError: it is not XML, is more than elements and attributes, or is too large.
    """
    name = clean(name)
    if len(data) > MAX_BYTES:
        raise ScenarioError(f"plant.model: {name}: too large; allowed: {MAX_BYTES} bytes of MJCF")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        problem = f"byte 0x{data[error.start]:02x}; allowed: XML in UTF-8"
        raise ScenarioError(f"plant.model: {name}:{line}: {problem}") from error
    return _Reader(name).read(text)


class _Reader:
    def __init__(self, name: str) -> None:
        self._name = name
        self._depth = self._count = 0
        self._line = 1  # of what was built last
        self._builder = ElementTree.TreeBuilder(element_factory=Tag)
        parser = self._parser = expat.ParserCreate(encoding="utf-8")
        parser.XmlDeclHandler = self._declared
        parser.StartDoctypeDeclHandler = self._refuse_doctype
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end

    def read(self, text: str) -> Tag:
        """The root."""
        try:
            self._parser.Parse(text, True)
        except expat.ExpatError as error:
            what = expat.ErrorString(error.code)
            allowed = "allowed: an MJCF, which is XML without entities of its own"
            raise self._error(error.lineno, f"not XML: {what}; {allowed}") from error
        return cast("Tag", self._builder.close())

    def _error(self, line: int, problem: str) -> ScenarioError:
        return ScenarioError(f"plant.model: {self._name}:{line}: {problem}")

    def _declared(self, version: str, encoding: str | None, standalone: int) -> None:
        if encoding is not None and encoding.lower() not in {"utf-8", "utf8", "us-ascii", "ascii"}:
            raise self._error(1, f"encoding = {show(encoding)}; allowed: UTF-8")

    def _refuse_doctype(self, name: str, *rest: Any) -> None:
        problem = f"<!DOCTYPE {clean(name)[:60]}>; allowed: no declaration of types or entities"
        raise self._error(self._parser.CurrentLineNumber, problem)

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        line = self._parser.CurrentLineNumber
        self._depth += 1
        self._count += 1
        if self._depth > MAX_DEPTH:
            raise self._error(line, f"nested too deeply; allowed: {MAX_DEPTH} levels")
        if self._count > MAX_ELEMENTS:
            raise self._error(line, f"too many elements; allowed: {MAX_ELEMENTS}")
        if len(attributes) > MAX_ATTRIBUTES:
            raise self._error(line, f"too many attributes; allowed: {MAX_ATTRIBUTES} of an element")
        self._builder.data("\n" * (line - self._line))
        self._line = line
        tag = cast("Tag", self._builder.start(name, attributes))
        tag.place, tag.line = f"{self._name}:{line}", line
        for key, value in attributes.items():
            _check_text(tag, key, value)

    def _end(self, name: str) -> None:
        self._depth -= 1
        self._builder.end(name)


def _check_text(tag: Tag, key: str, value: str) -> None:
    if not value.isprintable() and not SPACES.sub(" ", value).isprintable():
        problem = "holds characters that cannot be seen; allowed: printable ones and spaces"
        raise refuse(tag, problem, key)
    if len(value) > MAX_WORD and any(len(word) > MAX_WORD for word in value.split()):
        raise refuse(tag, f"holds a very long word; allowed: {MAX_WORD} characters", key)
