"""What a shell offers at <TAB>: names of scenarios, controllers and logs, keys and their values.

Everything is read from the names of files and from the shipped JSON Schema, since a shell waits:
nothing of the package that computes is imported.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import typer

from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.paths import (
    LAST,
    find_scenario,
    log_names,
    scenario_names,
    scenarios_dir,
    shipped_controllers,
)

MAX_READ = 64 * 1024  # characters of a scenario
_KIND = r"^{part}:.*\n(?:(?: .*|#.*|)\n)*?  kind: *(\w+)"  # of a part, in a scenario's text


def complete_scenario(incomplete: str) -> list[str]:
    """Shipped scenarios, YAML files and folders."""
    return [*_begin(scenario_names(), incomplete), *_files(incomplete, (".yaml", ".yml"))]


def complete_log(incomplete: str) -> list[str]:
    """Logs by name, the newest first; files of logs and tables, and folders."""
    names = log_names()
    found = _begin([*names, *([LAST] if names else [])], incomplete)
    return [*found, *_files(incomplete, (".mcap", ".parquet"))]


def complete_controller(incomplete: str) -> list[str]:
    """Kinds, shipped tuned controllers, YAML files and folders."""
    found = _begin([*_kinds(), *shipped_controllers()], incomplete)
    return [*found, *_files(incomplete, (".yaml", ".yml"))]


def complete_controllers(incomplete: str) -> list[str]:
    """The same after each comma."""
    before, comma, last = incomplete.rpartition(",")
    return [f"{before}{comma}{name}" for name in complete_controller(last)]


def complete_kind(incomplete: str) -> list[str]:
    """Kinds of controllers, and shipped tuned ones."""
    return _begin([*_kinds(), *shipped_controllers()], incomplete)


def complete_set(ctx: typer.Context, incomplete: str) -> list[str]:
    """The next part of a key path that the scenario on the line may have, or a key's values."""
    path, equals, _ = incomplete.partition("=")
    *above, last = path.split(".")
    schema = _schema()
    chosen = _chosen_kinds(ctx.params.get("scenario"), ctx.params.get("overrides") or ())
    parts = list(_alternatives(schema, schema, chosen.get("")))
    for depth, key in enumerate(above, start=1):
        kind = chosen.get(".".join(above[:depth]))
        parts = [below for part in parts for below in _below(schema, part, key, kind)]
    if not equals:
        return _begin(_next_keys(schema, parts, above), path)
    kind = None  # any may be chosen
    leaves = [leaf for part in parts for leaf in _below(schema, part, last, kind)]
    return _begin((f"{path}={word}" for word in _values(leaves, path)), incomplete)


def _begin(words: Iterable[str], incomplete: str) -> list[str]:
    return [word for word in dict.fromkeys(words) if word.startswith(incomplete)]


def _files(incomplete: str, suffixes: tuple[str, ...]) -> list[str]:
    """Files of these kinds and folders that a path begins, as it would be written on."""
    head, slash, start = incomplete.rpartition("/")
    found = []
    try:
        for path in sorted(Path(head + slash or ".").iterdir()):
            if path.name.startswith(start) and (start or not path.name.startswith(".")):
                if path.is_dir():
                    found.append(f"{head}{slash}{path.name}/")
                elif path.suffix in suffixes:
                    found.append(f"{head}{slash}{path.name}")
    except OSError:
        pass  # no such folder: nothing to offer
    return found


def _schema() -> dict[str, Any]:
    file = scenarios_dir() / "scenario.schema.json"
    schema: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return schema


def _kinds() -> list[str]:
    schema = _schema()
    controllers = _alternatives(schema, schema["properties"]["controller"], None)
    by_themselves = (part for part in controllers if set(part.get("required", ())) <= {"kind"})
    return [kind for part in by_themselves if (kind := _kind_of(part))]


def _chosen_kinds(scenario: str | None, overrides: Iterable[str]) -> dict[str, str]:
    """Kinds of controller and reference, as the command line has them so far."""
    chosen: dict[str, str] = {}
    if scenario is not None:
        try:
            with find_scenario(scenario).open(encoding="utf-8") as file:
                text = file.read(MAX_READ)
        except (DnnmsoError, OSError, UnicodeDecodeError):
            text = ""
        for part in ("controller", "reference"):
            if found := re.search(_KIND.format(part=part), text, re.MULTILINE):
                chosen[part] = found[1]
    for override in overrides:
        path, _, value = override.partition("=")
        if path.endswith(".kind"):
            chosen[path.removesuffix(".kind")] = value
    return chosen


def _kind_of(part: dict[str, Any]) -> str | None:
    kind: str | None = part.get("properties", {}).get("kind", {}).get("const")
    return kind


def _alternatives(
    schema: dict[str, Any], part: dict[str, Any], kind: str | None
) -> Iterator[dict[str, Any]]:
    """What may stand in a place: references followed; of several kinds only the chosen one."""
    if "$ref" in part:
        part = schema["$defs"][part["$ref"].rpartition("/")[2]]
    options = part.get("anyOf") or part.get("oneOf")
    if options:
        for option in options:
            yield from _alternatives(schema, option, kind)
    elif kind is None or _kind_of(part) in {kind, None}:
        yield part


def _below(
    schema: dict[str, Any], part: dict[str, Any], key: str, kind: str | None
) -> Iterator[dict[str, Any]]:
    below = part.get("items") if key.isdecimal() else part.get("properties", {}).get(key)
    if below:
        yield from _alternatives(schema, below, kind)


def _next_keys(
    schema: dict[str, Any], parts: list[dict[str, Any]], above: list[str]
) -> Iterator[str]:
    """Paths one key longer; they end in "." where more keys follow, else in "="."""
    for part in parts:
        for key in part.get("properties", ()):
            groups = any("properties" in below for below in _below(schema, part, key, None))
            yield ".".join([*above, key]) + ("." if groups else "=")


def _values(leaves: list[dict[str, Any]], path: str) -> Iterator[str]:
    for leaf in leaves:
        yield from leaf.get("enum", [leaf["const"]] if "const" in leaf else [])
        if leaf.get("type") in {"boolean", "null"}:
            yield from ("true", "false") if leaf["type"] == "boolean" else ("null",)
    if path == "controller.from":
        yield from shipped_controllers()
