"""Values, keys and near misses as people read them, on one line and without control characters."""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Iterable

KeyPath = tuple[str | int, ...]

LONGEST = 60


def clean(text: str) -> str:
    """Escape whatever would break the line or the terminal: control characters, surrogates."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def shorten(text: str) -> str:
    """Cut a long text in the middle."""
    if len(text) <= LONGEST:
        return text
    return f"{text[: LONGEST - 15]} … {text[-10:]}"


def dotted(path: KeyPath) -> str:
    """A key path as `--set` takes it: plant.masses.1."""
    return shorten(clean(".".join(str(part) or "''" for part in path)))


def show(value: object) -> str:
    """A value as YAML would have it: "text", [1, 2], true, null, .nan."""
    return shorten(_flow(value))


def did_you_mean(word: object, choices: Iterable[str]) -> str:
    """`; did you mean 'x'?` when a choice is near, else nothing."""
    if not isinstance(word, str):
        return ""
    folded = {choice.lower(): choice for choice in choices}
    near = difflib.get_close_matches(word.lower()[:100], folded, n=1)
    return f"; did you mean '{folded[near[0]]}'?" if near else ""


def _flow(value: object) -> str:
    # A value longer than what is shown is not spelled out to its end.
    match value:
        case None | bool() | str():
            return clean(json.dumps(value, ensure_ascii=False))
        case float():
            return _float(value)
        case list() | tuple():
            return "[" + ", ".join(_flow(item) for item in value[:LONGEST]) + "]"
        case dict():
            items = list(value.items())[:LONGEST]
            return "{" + ", ".join(f"{clean(str(k))}: {_flow(v)}" for k, v in items) + "}"
        case _:
            return str(value)


def _float(value: float) -> str:
    if math.isfinite(value):
        return repr(value)
    if math.isnan(value):
        return ".nan"
    return ".inf" if value > 0 else "-.inf"
