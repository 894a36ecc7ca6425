"""A scenario written out as a commented file: every key with its meaning, default and range."""

from __future__ import annotations

import io
import os
import re
import textwrap
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.representer import RoundTripRepresenter

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.files import whole_file
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.loading.shape import ABSENT, Shape
from dnnmso_mj.paths import scenario_names, scenarios_dir
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.wording import clean, show

WIDTH = 100
INDENT = 2
NAME = Scenario.model_fields["name"].metadata[0].pattern


class _Plain(RoundTripRepresenter):
    """Null written out."""


_Plain.add_representer(
    type(None), lambda here, _: here.represent_scalar("tag:yaml.org,2002:null", "null")
)


def new_scenario(
    name: str,
    source: str | Path = "paper",
    controller: str | None = None,
    out: Path | None = None,
) -> Path:
    """Write a scenario to start from.

    Args:
        name: of the scenario, and of its file.
        source: the scenario that it is as at first, by name or file.
        controller: what replaces its controller: a kind, a shipped tuned one, or a file.
        out: the file; NAME.yaml unless given.

    Returns:
        The file, which loads as `source` does but for its name.

    Raises:
        ScenarioError: the name is none or a shipped scenario's, `source` or `controller` cannot be
            loaded, or the file exists or cannot be written.
    """
    name = name.removesuffix(".yaml")
    if not re.fullmatch(NAME, name):
        meaning = str(Scenario.model_fields["name"].description).split(";")[0]
        raise ScenarioError(f"NAME = {show(name)}: is not a name; allowed: {meaning}")
    if name in scenario_names():
        raise ScenarioError(
            f"NAME = {name}: a scenario that ships; allowed: another name, as in my_{name}"
        )
    file = out or Path(f"{name}.yaml")
    scenario = load_scenario(source, controller=controller)
    text = scenario_text(scenario.model_copy(update={"name": name}), file, str(source))
    try:
        with whole_file(file, replace=False) as stream:
            stream.write(text.encode())
    except FileExistsError as error:
        raise ScenarioError(
            f"{clean(str(file))}: exists; allowed: another NAME, another --out, or remove it first"
        ) from error
    except OSError as error:
        raise ScenarioError(
            f"{clean(str(file))}: cannot be written: {error.strerror}; allowed: another --out"
        ) from error
    return file


def scenario_text(scenario: Scenario, file: Path, source: str) -> str:
    """The YAML of a scenario, all of it spelled out and explained.

    Args:
        scenario: what is written.
        file: where it will stand, for its way to the schema.
        source: what it was made from.
    """
    yaml = YAML()
    yaml.Representer = _Plain
    yaml.width = 10_000  # long texts stay on their line
    yaml.indent(mapping=INDENT, sequence=2 * INDENT, offset=INDENT)
    stream = io.StringIO()
    yaml.dump(_group(scenario, Shape.root(), 0), stream)
    head = (
        f"# yaml-language-server: $schema={_schema_from(file)}\n#\n"
        f"# Begun from {clean(source)}. Every key is here, with its meaning, its default and what\n"
        "# is allowed; a key that is left out has its default. To run it:\n"
        f"#   dnnmso run {clean(str(file))}\n\n"
    )
    return head + stream.getvalue()


def _schema_from(file: Path) -> str:
    """The shipped schema as an editor finds it: from the file where both are near, else from /."""
    schema, here = scenarios_dir() / "scenario.schema.json", Path.cwd()
    folder = file.absolute().parent
    if schema.is_relative_to(here) and folder.is_relative_to(here):
        return Path(os.path.relpath(schema, folder)).as_posix()
    return schema.as_uri() if " " in str(schema) else schema.as_posix()


def _group(part: BaseModel, shape: Shape, depth: int) -> CommentedMap:
    """A part with a comment before each of its keys."""
    data = part.model_dump()
    own, kinds = shape.of_kind(data), tuple(shape.kinds)
    group = CommentedMap()
    for key in type(part).model_fields:
        below = own.child(key)
        if below is None:
            continue
        value = getattr(part, key)
        group[key] = _value(value, below, depth + 1)
        comment = _about_kind(part, kinds) if key == "kind" and kinds else _about(value, below)
        indent = depth * INDENT
        lines = _wrapped(comment, WIDTH - indent - 2)
        if depth == 0 and isinstance(value, BaseModel | list | tuple):
            lines = ["", *lines]
        group.yaml_set_comment_before_after_key(key, before="\n".join(lines), indent=indent)
    return group


def _wrapped(comment: tuple[str, str], width: int) -> list[str]:
    """The meaning, and what is allowed, on one line if both fit there."""
    whole = " ".join(comment).strip()
    pieces = [whole] if len(whole) <= width else comment
    return [line for p in pieces for line in textwrap.wrap(p, width, break_on_hyphens=False)]


def _value(value: Any, shape: Shape, depth: int) -> Any:
    if isinstance(value, BaseModel):
        return _group(value, shape, depth)
    if not isinstance(value, tuple):
        return value
    items = shape.child(0)
    if value and isinstance(value[0], BaseModel) and items is not None:
        return CommentedSeq([_group(item, items, depth + 1) for item in value])
    return value[0] if _stands_for_all(value, shape) else _flow(value)


def _stands_for_all(values: Any, shape: Shape) -> bool:
    """Whether a list of one may be written as that one: it is of each joint or state."""
    is_one = isinstance(values, list | tuple) and len(values) == 1
    return is_one and "or a list" in shape.words


def _flow(values: tuple[Any, ...]) -> CommentedSeq:
    row = CommentedSeq(_flow(v) if isinstance(v, tuple) else v for v in values)
    row.fa.set_flow_style()
    return row


def _about(value: Any, shape: Shape) -> tuple[str, str]:
    """What a key means; and of a value, its default and what is allowed."""
    meaning = f"{shape.description.rstrip('.')}."
    items = shape.child(0) if isinstance(value, tuple) else None
    if items is not None and (items.keys or items.kinds):
        return meaning, f"Default []; {_entries(items)}"
    if isinstance(value, BaseModel):
        return meaning, ""
    allowed = shape.words.removeprefix("one of: ")
    if shape.default is ABSENT:
        return meaning, f"Allowed: {allowed}."
    default = shape.default[0] if _stands_for_all(shape.default, shape) else shape.default
    return meaning, f"Default {show(default)}; allowed: {allowed}."


def _about_kind(part: BaseModel, kinds: tuple[str, ...]) -> tuple[str, str]:
    return (type(part).__doc__ or "").split("\n")[0], f"Allowed: {', '.join(kinds)}."


def _entries(items: Shape) -> str:
    """What a list of groups may hold."""
    if not items.kinds:
        return f"allowed: entries with {', '.join(items.keys)}."
    each = (f"kind: {kind} with {_others(below)}" for kind, below in items.kinds.items())
    return f"allowed: entries of {'; '.join(each)}."


def _others(shape: Shape) -> str:
    return ", ".join(key for key in shape.keys if key != "kind")
