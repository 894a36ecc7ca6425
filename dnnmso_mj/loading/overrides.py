"""`--set a.b=c`: changes to a scenario's data, made before it is validated.

The value is YAML: a number, a word, null, [1, 2]. The path may go through keys that the file leaves
out, and to one entry of a list (plant.masses.1=3). The last of two equal paths wins.

When a `kind` is set to another one, keys that belonged to the old kind and are unknown to the new
are dropped, so that `controller.kind=no_network` works on a file that describes a network. Keys
that were themselves set are never dropped: one that does not fit is refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.loading.complaints import Complaint, complain
from dnnmso_mj.loading.documents import MAX_DEPTH, read_document
from dnnmso_mj.loading.shape import ABSENT, Shape, lookup
from dnnmso_mj.loading.trust import anchored
from dnnmso_mj.wording import KeyPath, clean, dotted, shorten, show

LONGEST = 300  # characters of an override that are told whole
FORM = "allowed: KEY.PATH=VALUE, as in plant.gravity=1.62"


@dataclass(frozen=True)
class Override:
    """One `--set`."""

    text: str
    path: tuple[str, ...]
    value: Any

    @property
    def place(self) -> str:
        """How messages call it."""
        return _place(self.text)

    def covers(self, path: KeyPath) -> bool:
        """Whether the value at `path` came from here."""
        return tuple(map(str, path[: len(self.path)])) == self.path

    def enters(self, path: KeyPath) -> bool:
        """Whether this sets something below `path`."""
        return self.path[: len(path)] == tuple(map(str, path))


def parse_overrides(texts: Sequence[str]) -> tuple[Override, ...]:
    """Read `a.b=c` strings.

    Raises:
        ScenarioError: one line for each that is malformed.
    """
    found = [_parse(text) for text in texts]
    problems = [item for item in found if isinstance(item, str)]
    if problems:
        raise ScenarioError("\n".join(problems))
    return tuple(item for item in found if isinstance(item, Override))


def apply_overrides(data: dict[str, Any], overrides: Sequence[Override]) -> list[Complaint]:
    """Change `data` in place; complain about paths that lead through a value or past a list."""
    before = deepcopy(data)
    complaints = [c for override in overrides if (c := _put(data, override)) is not None]
    return complaints + list(_drop_foreign(Shape.root(), data, before, (), overrides))


def _place(text: str) -> str:
    return f"--set {clean(text if len(text) <= LONGEST else shorten(text))}"


def _parse(text: str) -> Override | str:
    """The override, or what is wrong with it."""
    place = _place(text)
    keys, equals, value = text.partition("=")
    path = tuple(key.strip() for key in keys.split("."))
    if not equals:
        return f"{place}: no '='; {FORM}"
    if not all(path):
        return f"{place}: an empty key; {FORM}"
    if len(path) > MAX_DEPTH:
        return f"{place}: {len(path)} keys deep; allowed: at most {MAX_DEPTH}"
    root, problems = read_document(value)
    if problems:
        return f"{place}: {problems[0].text}"
    if root is None:
        return f"{place}: no value; {FORM}; null for nothing, '' for an empty text"
    key, here = path[-1], Path.cwd()
    return Override(text, path, anchored({key: root.plain()}, here)[key])


def _put(data: dict[str, Any], override: Override) -> Complaint | None:
    """Set one value, making the parts on the way out of their defaults."""
    here: Any = data
    path: KeyPath = ()
    for key in override.path[:-1]:
        part = _part(here, key)
        if part is None:
            return _lost(override, path, data)
        path = (*path, part)
        if isinstance(here, dict) and part not in here:
            shape = Shape.root().at(path, data)
            here[part] = _begin(shape.default if shape else ABSENT)
        here = here[part]
    last = _part(here, override.path[-1])
    if last is None:
        return _lost(override, path, data)
    here[last] = override.value
    return None


def _begin(default: Any) -> Any:
    """A part to be filled in. Keys that are left out of a group keep their own defaults."""
    if isinstance(default, dict):
        return {key: value for key, value in default.items() if key == "kind"}
    return {} if default is ABSENT else deepcopy(default)


def _part(here: Any, key: str) -> Any:
    """`key` as `here` is indexed by: a key, a number of an entry, or None for neither."""
    if isinstance(here, dict):
        return key
    number = int(key) if key.isdecimal() and len(key) < 9 else -1
    return number if lookup(here, (number,)) is not ABSENT else None


def _lost(override: Override, path: KeyPath, data: Any) -> Complaint:
    """The path leads on where there is nothing more."""
    here = lookup(data, path)
    entries = isinstance(here, list) and len(here) > 0
    allowed = f"entries 0 to {len(here) - 1}" if entries else "a whole new value"
    rest = ".".join(override.path[len(path) :])
    problem = f"has no entry {clean(rest)}; allowed: {allowed}"
    return Complaint(override.path, complain(path, data, problem).text)


def _drop_foreign(
    shape: Shape, now: Any, before: Any, path: KeyPath, overrides: Sequence[Override]
) -> Iterator[Complaint]:
    """Remove what an old kind leaves behind, here and below; complain of overrides in it."""
    if not isinstance(now, dict):
        return
    old = shape.of_kind(shape.default if before is ABSENT else before)
    new = shape.of_kind(now)
    if shape.kinds and new.keys:
        for key in (key for key in old.keys if key not in new.keys):
            where = (*path, key)
            if any(item.covers(where) for item in overrides):
                continue  # refused like any other key that does not fit
            now.pop(key, None)
            for item in overrides:
                if item.enters(where):
                    kind = f"{dotted(path)}.kind = {now['kind']} has no {key}"
                    allowed = f"allowed: {', '.join(new.keys)}"
                    text = f"{dotted(item.path)} = {show(item.value)}: {kind}; {allowed}"
                    yield Complaint(item.path, text)
    for key in new.keys:
        below = new.child(key)
        if below is not None and key in now:
            yield from _drop_foreign(
                below, now[key], lookup(before, (key,)), (*path, key), overrides
            )
