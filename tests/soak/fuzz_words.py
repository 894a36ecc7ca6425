"""What scenarios are made of: key paths, values, and a small one that is whole."""

from __future__ import annotations

from collections.abc import Iterator

from dnnmso_mj.loading.shape import Shape
from dnnmso_mj.scenario import Scenario

SCENARIO = """\
name: small
duration: 0.1
reference: {kind: sinusoid}
controller:
  kind: dnn_mso
  network: {hidden: [4, 4]}
events:
  - {kind: payload, at: 0.05, mass: 1.0}
"""
VALUES = (
    "1", "-1", "0", "1e-3", "0.5", ".nan", ".inf", "-.inf", "1e308", "1e-320", "null", "~", "true",
    "no", "''", '"a"', "[]", "{}", "[1, 2]", "[[1, 2], [3]]", "{kind: pd}", "{kind: nothing}",
    "{kind: {}}", "[{kind: push, at: 0.1}]", "0x10", "0o7", "99999999999999999999", "1_000",
    "!!python/object:os.system x", "&a [*a]", "*b", "|\n x", "folder", "fifo", "/dev/zero",
    "/dev/stdin", "../..", "~root", "two_link", "paper.yaml", "a:B", "x.py:F", "\N{NO-BREAK SPACE}",
    "\N{ZERO WIDTH NO-BREAK SPACE}1", "\N{ARABIC-INDIC DIGIT ONE}", "a: b", "? a", "- 1",
    "%YAML 1.1", "---", "...", "2026-01-01", "1:30", "<<", "'", '"', "#", "@", "`",
)  # fmt: skip


def _paths(shape: Shape, path: str = "", depth: int = 0) -> Iterator[str]:
    """Every key path that some scenario may have, lists by their first entry."""
    if depth > 8:
        return
    if path:
        yield path
    alternatives = [*shape.kinds.values()] or [shape]
    for part in alternatives:
        for key in part.keys:
            below = part.child(key)
            if below is not None:
                yield from _paths(below, f"{path}.{key}" if path else key, depth + 1)
        entry = part.child(0)
        if entry is not None:
            yield from _paths(entry, f"{path}.0", depth + 1)
    if shape.kinds:
        yield f"{path}.kind"


PATHS = [*dict.fromkeys(_paths(Shape.of(Scenario))), "controller.from"]


def _kinds() -> Iterator[str]:
    """Every kind of anything."""
    for path in PATHS:
        part = Shape.root().at(tuple(path.split(".")), {})
        yield from part.kinds if part else ()


_KEYS = dict.fromkeys(key for path in PATHS for key in path.split("."))
_MARKS = ("controller.", "plant.", ".", "=", ": ", "\n", "\n  ", "- ", ", ")
WORDS = [*_KEYS, *dict.fromkeys(_kinds()), *VALUES, *_MARKS]
