"""Turn pydantic's errors into complaints that name the key path, the value and what is allowed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from dnnmso_mj.loading.shape import ABSENT, Shape, lookup
from dnnmso_mj.wording import KeyPath, did_you_mean, dotted, show

MAX_EXPLAINED = 500  # of thousands, those that are told are enough; each takes time to put in words

_KINDS = {
    bool: "is true or false",
    int: "is a whole number",
    float: "is a number",
    str: "is text",
    list: "is a list",
    dict: "is a group of keys",
    type(None): "is empty",
}
_WHAT = {
    ("literal_error", str): "is none of the choices",
    ("union_tag_invalid", str): "is none of the choices",
    ("string_pattern_mismatch", str): "is not a name",
    ("string_unicode", str): "holds half a character (a surrogate)",
    ("int_type", float): "is not written as a whole number",
}


@dataclass(frozen=True)
class Complaint:
    """What is wrong at one key path of a scenario; `text` names the path and the value."""

    path: KeyPath
    text: str
    missing: bool = False
    untold: int = 0  # problems beside it that were not put in words


def complain(path: KeyPath, data: Any, problem: str, root: Shape | None = None) -> Complaint:
    """`key.path = VALUE: problem`, the value taken from `data` or from the defaults."""
    value, note = lookup(data, path), ""
    if value is ABSENT:
        shape = (root or Shape.root()).at(path, data)
        value, note = (shape.default, " (the default)") if shape else (ABSENT, "")
    shown = "" if value is ABSENT else f" = {show(value)}{note}"
    return Complaint(path, f"{dotted(path)}{shown}: {problem}")


def explain(error: ValidationError, data: Any, root: Shape | None = None) -> list[Complaint]:
    """Every complaint of a failed validation of `data`, in pydantic's order.

    Args:
        error, data: what was refused.
        root: what may stand in the whole document; a scenario's, unless given.
    """
    root = root or Shape.root()
    out: list[Complaint] = []
    details = error.errors(include_url=False, include_input=False)
    for detail in details[:MAX_EXPLAINED]:
        path = _key_path(detail["loc"], data, root)
        problems = detail.get("ctx", {}).get("problems")
        if problems is None:
            out += _explain(detail, path, data, root)
            continue
        for below, problem in problems:
            whole = (*path, *(int(p) if p.isdecimal() else p for p in below.split(".")))
            out.append(complain(whole, data, problem, root))
    if len(details) > MAX_EXPLAINED:
        out[-1] = replace(out[-1], untold=len(details) - MAX_EXPLAINED)
    return out


def _key_path(loc: tuple[str | int, ...], data: Any, root: Shape) -> KeyPath:
    """Where an error is in the file: without the tags of unions that pydantic puts in between.

    One number that stands for a list is checked as a list of one; its index is left out too.
    """
    path: list[str | int] = []
    shape: Shape | None = root
    value = data
    for part in loc:
        if shape and shape.kinds:
            shape = shape.kinds.get(str(part))
            continue
        if isinstance(part, int) and not isinstance(value, list):
            break
        path.append(part)
        shape = shape.child(part) if shape else None
        value = lookup(value, (part,))
    return tuple(path)


def _explain(detail: ErrorDetails, path: KeyPath, data: Any, root: Shape) -> list[Complaint]:
    kind = detail["type"]
    if kind.startswith("union_tag"):
        path = (*path, "kind")
    value = lookup(data, path)
    if kind == "extra_forbidden":
        parent = root.at(path[:-1], data)
        keys = parent.of_kind(lookup(data, path[:-1])).keys if parent else ()
        allowed = f"allowed: {', '.join(keys)}{did_you_mean(path[-1], keys)}"
        return [complain(path, data, f"unknown key; {allowed}", root)]
    shape = root.at(path, data)
    allowed = shape.words if shape else "another value"
    if kind == "too_short" and not _is_short(value, detail["ctx"]["min_length"]):
        return []  # pydantic does not count entries that are wrong themselves
    if shape and shape.description and (value is ABSENT or kind == "string_pattern_mismatch"):
        allowed += f" ({shape.description.rstrip('.')})"
    if value is ABSENT:
        return [Complaint(path, f"{dotted(path)}: missing key; allowed: {allowed}", True)]
    choices = shape.choices if shape else ()
    hint = did_you_mean(value, choices)
    if shape and shape.kinds and path[-1] != "kind" and value in choices:
        hint = f"; did you mean {dotted((*path, 'kind'))}={value}?"
    problem = f"{_what(kind, value)}; allowed: {allowed}{hint}"
    return [complain(path, data, problem, root)]


def _is_short(value: Any, least: int) -> bool:
    return isinstance(value, list) and len(value) < least


def _what(kind: str, value: Any) -> str:
    """What is wrong with a value, by pydantic's type of error."""
    if isinstance(value, float) and not math.isfinite(value):
        return "is not finite"
    if kind in {"too_short", "too_long"}:
        return f"has {len(value)} entries" if value else "is an empty list"
    if kind.startswith(("greater_than", "less_than")):
        return "is out of range"
    return _WHAT.get((kind, type(value))) or _KINDS.get(type(value), "is of a wrong type")
