"""The scenario reference: every key of the JSON schema, where a page asks for it.

A section is a Strict model of `dnnmso_mj.scenario`; its keys have the anchors `section.key`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

from dnnmso_mj.loading import scenario_schema
from dnnmso_mj.loading.shape import ABSENT, Shape

PLACE = "<!-- make docs: scenario -->"
HEAD = "| key | meaning | allowed | unit | default |\n| --- | --- | --- | --- | --- |\n"
UNIT = re.compile(r"\(((?:rad|kg|Hz|m|s|N|1/s|%)(?:[·/²³√0-9a-z/]|N·m|N)*)\)", re.IGNORECASE)

Schema = dict[str, Any]


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put the whole reference in its place."""
    return markdown.replace(PLACE, "\n".join(_reference())) if PLACE in markdown else markdown


def _reference() -> Iterator[str]:
    schema = scenario_schema()
    models = schema["$defs"]
    yield f"## The scenario itself {{ #scenario }}\n\n{_table('scenario', schema, models)}"
    seen: set[str] = set()
    for key, value in schema["properties"].items():
        names = [name for name in _nested(value, models) if name not in seen]
        seen.update(names)
        if names:
            yield f"## {key} {{ #{key} }}\n\n{value['description']}\n"
        for name in names:
            yield _section(name, models, name in _models(value))


def _nested(schema: Schema, models: Schema) -> list[str]:
    """The models that a key leads to, and those that they lead to, each once, in their order."""
    direct = _models(schema)
    deeper = [name for model in direct for name in _nested(models[model], models)]
    return list(dict.fromkeys([*direct, *deeper]))


def _models(schema: object) -> list[str]:
    """The models that a part of the schema points at."""
    return list(dict.fromkeys(re.findall(r"'#/\$defs/(\w+)'", repr(schema))))


def _section(name: str, models: Schema, direct: bool) -> str:
    model = models[name]
    kind = model["properties"].get("kind", {}).get("const")
    title = f"`kind: {kind}`" if kind and direct else f"{name}, `kind: {kind}`" if kind else name
    said = model.get("description", "")
    return f"### {title} {{ #{name.lower()} }}\n\n{said}\n\n{_table(name.lower(), model, models)}"


def _table(anchor: str, model: Schema, models: Schema) -> str:
    required = model.get("required", [])
    rows = [
        _row(f"{anchor}.{key}", key in required, Shape(value, models))
        for key, value in model["properties"].items()
    ]
    return HEAD + "".join(rows)


def _row(anchor: str, required: bool, shape: Shape) -> str:
    unit = UNIT.search(shape.description)
    cells = [
        f'<code id="{anchor}">{anchor.rpartition(".")[2]}</code>',
        shape.description,
        _allowed(shape),
        unit[1] if unit else "",
        "required" if required else _default(shape.default),
    ]
    plain = [cell.replace("|", "&#124;").replace("\n", " ") for cell in cells]
    return f"| {' | '.join(plain)} |\n"


def _allowed(shape: Shape) -> str:
    """In the words of error messages; models are links to their sections."""
    options = shape.schema.get("anyOf", [shape.schema])
    return " or ".join(_option(Shape(option, shape.parts)) for option in options)


def _option(shape: Shape) -> str:
    if shape.kinds:
        return ", ".join(
            f"[{kind}]{_link(_models(part.schema)[0])}" for kind, part in shape.kinds.items()
        )
    if "properties" in shape.schema:
        return ", ".join(f"`{{{key}: …}}`, {shape.description}" for key in shape.keys)
    links = ", ".join(f"[{name}]{_link(name)}" for name in _models(shape.schema))
    return ": ".join(part for part in ("" if shape.keys else shape.words, links) if part)


def _link(model: str) -> str:
    return f"(#{model.lower()})"


def _default(default: Any) -> str:
    if default is ABSENT:
        return ""
    if isinstance(default, list) and len(default) == 1:
        default = default[0]  # one number stands for all
    if isinstance(default, dict):
        return f"`{{kind: {default['kind']}}}`" if "kind" in default else "its own"
    return f"`{json.dumps(default, ensure_ascii=False)}`"
