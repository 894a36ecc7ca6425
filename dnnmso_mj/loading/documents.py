"""Read one YAML 1.2 document, untrusted, into plain values that know their lines.

ruamel.yaml turns the text into events; they are put together here, without recursion, so that
deep nesting and bombs of aliases are stopped by counting, before anything is expanded. Nothing
is ever constructed but numbers, texts, true, false, null, lists and mappings.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from ruamel.yaml import YAML
from ruamel.yaml import events as ev
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.reader import ReaderError

from dnnmso_mj.wording import KeyPath, clean, dotted, shorten

MAX_NODES = 10_000  # ruamel.yaml takes 0.05 ms for each
MAX_DEPTH = 32
MAX_DIGITS = 100

# The core schema of YAML 1.2.2, section 10.3.2.
_NULL = re.compile(r"~|null|Null|NULL|")
_BOOL = re.compile(r"true|True|TRUE|false|False|FALSE")
_INT = re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_INF_NAN = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")


class Problem(NamedTuple):
    """What is wrong, and on which line, counted from 1."""

    line: int
    text: str


@dataclass
class Node:
    """A value and the line that it, or its key, stands on.

    Args:
        value: a scalar, a list of nodes, or a dict of nodes.
        size: number of nodes from here down, aliases expanded.
        height: levels of nesting from here down.
    """

    line: int
    value: Any
    size: int = 1
    height: int = 1

    def plain(self) -> Any:
        """The value in lists, dicts and scalars of its own, aliases copied."""
        if isinstance(self.value, dict):
            return {key: node.plain() for key, node in self.value.items()}
        if isinstance(self.value, list):
            return [node.plain() for node in self.value]
        return self.value

    def line_of(self, path: KeyPath) -> int:
        """The line of the value at `path`, or of the nearest part above it that is there."""
        node = self
        for part in path:
            try:
                below = node.value[part]
            except (KeyError, IndexError, TypeError):
                break
            if not isinstance(below, Node):  # a letter of a text
                break
            node = below
        return node.line


def read_document(text: str) -> tuple[Node | None, list[Problem]]:
    """Parse one YAML 1.2 document.

    Returns:
        Its root, or None when it cannot be read to its end, and everything that is wrong with it.
        Duplicate keys and tags do not stop the reading; the first of two equal keys is kept.
    """
    builder = _Builder()
    try:
        for event in YAML(typ="safe", pure=True).parse(text):
            builder.feed(event)
    except _UnreadableError as stop:
        return None, [*builder.problems, stop.problem]
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        parts = (error.context, error.problem)
        what = ", ".join(clean(str(part)) for part in parts if part)
        line = mark.line + 1 if mark else 1
        return None, [*builder.problems, Problem(line, f"not valid YAML: {what}")]
    except ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        what = f"not valid YAML: the character U+{error.character:04X} is not allowed"
        return None, [Problem(line, what)]
    except AssertionError:  # so ruamel.yaml puts it
        what = "a directive %YAML of a version that is none; allowed: YAML 1.2"
        return None, [*builder.problems, Problem(builder.line, what)]
    except (YAMLError, ValueError, OverflowError):  # the escape \UFFFFFFFF, from line on
        what = "not valid YAML: an escape or a directive that stands for nothing"
        return None, [*builder.problems, Problem(builder.line, what)]
    return builder.root, builder.problems


class _UnreadableError(Exception):
    def __init__(self, line: int, text: str) -> None:
        self.problem = Problem(line, text)


@dataclass
class _Open:
    """A collection that is being filled."""

    node: Node
    anchor: str | None
    key: str | None = None
    key_line: int = 0


@dataclass
class _Builder:
    root: Node | None = None
    problems: list[Problem] = field(default_factory=list)
    stack: list[_Open] = field(default_factory=list)
    anchors: dict[str, Node] = field(default_factory=dict)
    nodes: int = 0
    line: int = 1

    def feed(self, event: ev.Event) -> None:
        """Take one event of the parser."""
        line = self.line = event.start_mark.line + 1
        match event:
            case ev.DocumentStartEvent():
                self._start_document(event, line)
            case ev.ScalarEvent():
                self._scalar(event, line)
            case ev.AliasEvent():
                self._alias(event.anchor, line)
            case ev.CollectionStartEvent():
                self._refuse_tag(event, line)
                self._refuse_as_key(line)
                value: Any = {} if isinstance(event, ev.MappingStartEvent) else []
                self.stack.append(_Open(Node(line, value), event.anchor))
                self._limit(line, size=1, height=1)
            case ev.CollectionEndEvent():
                done = self.stack.pop()
                self._attach(done.node, done.anchor)

    def _start_document(self, event: ev.DocumentStartEvent, line: int) -> None:
        if self.root is not None:
            raise _UnreadableError(line, "a second document begins; allowed: one document a file")
        if event.version not in {None, (1, 2)}:
            found = ".".join(map(str, event.version))
            raise _UnreadableError(line, f"%YAML {found}; allowed: YAML 1.2")

    def _scalar(self, event: ev.ScalarEvent, line: int) -> None:
        self._refuse_tag(event, line)
        frame = self.stack[-1] if self.stack else None
        if frame and isinstance(frame.node.value, dict) and frame.key is None:
            frame.key, frame.key_line = event.value, line
            return
        value = event.value
        if not event.style:  # plain: neither quoted nor a block of text
            try:
                value = _resolve(value)
            except ValueError as error:
                self.problems.append(Problem(line, f"{self._where()}{error}"))
        self._limit(line, size=1, height=1)
        self._attach(Node(line, value), event.anchor)

    def _alias(self, anchor: str, line: int) -> None:
        self._refuse_as_key(line)
        if anchor not in self.anchors:
            name = shorten(clean(anchor))
            raise _UnreadableError(line, f"*{name} stands for nothing; allowed: an earlier &{name}")
        node = self.anchors[anchor]
        self._limit(line, node.size, node.height)
        self._attach(replace(node, line=line), None)

    def _attach(self, node: Node, anchor: str | None) -> None:
        """Put a finished node in its place, and remember its anchor."""
        if anchor is not None:
            self.anchors[anchor] = node
        if not self.stack:
            self.root = node
            return
        frame = self.stack[-1]
        parent = frame.node
        parent.size += node.size
        parent.height = max(parent.height, node.height + 1)
        if isinstance(parent.value, list):
            parent.value.append(node)
            return
        key, frame.key = str(frame.key), None
        if key in parent.value:
            path = dotted((*self._path(), key))
            first = parent.value[key].line
            text = f"{path}: duplicate key, first given on line {first}; allowed: once"
            self.problems.append(Problem(frame.key_line, text))
        else:
            parent.value[key] = replace(node, line=frame.key_line)

    def _limit(self, line: int, size: int, height: int) -> None:
        self.nodes += size
        if self.nodes > MAX_NODES:
            raise _UnreadableError(line, f"too many values; allowed: at most {MAX_NODES}")
        if len(self.stack) + height > MAX_DEPTH:
            raise _UnreadableError(line, f"nested too deeply; allowed: {MAX_DEPTH} levels")

    def _refuse_as_key(self, line: int) -> None:
        frame = self.stack[-1] if self.stack else None
        if frame and isinstance(frame.node.value, dict) and frame.key is None:
            raise _UnreadableError(line, "a list, a mapping or an alias as a key; allowed: a word")

    def _refuse_tag(self, event: ev.ScalarEvent | ev.CollectionStartEvent, line: int) -> None:
        if event.tag is not None:
            tag = shorten(clean(str(event.tag)))
            text = f"{self._where()}the tag {tag}; allowed: values without a tag"
            self.problems.append(Problem(line, text))

    def _path(self) -> KeyPath:
        """Where the collection being filled stands."""
        above = self.stack[:-1]
        return tuple(
            len(frame.node.value) if isinstance(frame.node.value, list) else str(frame.key)
            for frame in above
        )

    def _where(self) -> str:
        if not self.stack:
            return ""
        frame = self.stack[-1]
        last = len(frame.node.value) if isinstance(frame.node.value, list) else frame.key
        path = self._path() if last is None else (*self._path(), last)
        return f"{dotted(path)}: " if path else ""


def _resolve(text: str) -> Any:
    """A plain scalar's value. Raises ValueError for a number of too many digits."""
    if _NULL.fullmatch(text):
        return None
    if _BOOL.fullmatch(text):
        return text.lower() == "true"
    if _INF_NAN.fullmatch(text):
        return float(text.replace(".", ""))
    if not _FLOAT.fullmatch(text) and not _INT.fullmatch(text):
        return text
    if len(text) > MAX_DIGITS:
        raise ValueError(f"a number of {len(text)} characters; allowed: at most {MAX_DIGITS}")
    if _INT.fullmatch(text):
        base = {"0o": 8, "0x": 16}.get(text[:2], 10)
        return int(text, base)
    return float(text)
