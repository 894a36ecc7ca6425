"""What may stand where in a scenario: its JSON Schema, and that schema in words for people."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaMode
from pydantic_core import CoreSchema

from dnnmso_mj.scenario import Scenario
from dnnmso_mj.wording import KeyPath

DIALECT = "https://json-schema.org/draft/2020-12/schema"

ABSENT: Any = object()

_NOUNS = {
    "number": ("a number", "numbers"),
    "integer": ("a whole number", "whole numbers"),
    "string": ("text", "texts"),
    "boolean": ("true or false", "true or false"),
    "null": ("null", "null"),
    "object": ("a group of keys", "groups of keys"),
}


_FROM = {
    "type": "object",
    "description": "A tuned controller; further keys override it.",
    "properties": {
        "from": {
            "type": "string",
            "description": "A shipped tuned controller's name, or its path from this file.",
        }
    },
    "required": ["from"],
}


class _Plain(GenerateJsonSchema):
    """Keys are their own titles."""

    def field_title_should_be_set(self, schema: object) -> bool:
        return False

    def generate(self, schema: CoreSchema, mode: JsonSchemaMode = "validation") -> dict[str, Any]:
        return {"$schema": DIALECT, **super().generate(schema, mode)}


def scenario_schema() -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of a scenario; keys with a default are not required.

    A controller may also be one that `from` names; what is beside it is checked when it is loaded.
    """
    schema = Scenario.model_json_schema(schema_generator=_Plain)
    kinds = schema["properties"]["controller"]
    description = {"description": kinds.pop("description")} if "description" in kinds else {}
    schema["properties"]["controller"] = {"anyOf": [kinds, _FROM], **description}
    return schema


@dataclass(frozen=True)
class Shape:
    """What may stand at one place.

    Args:
        schema: that place's part of the schema.
        parts: the schema's definitions, which `$ref` points at.
    """

    schema: Mapping[str, Any]
    parts: Mapping[str, Any]

    @classmethod
    @cache
    def root(cls) -> Shape:
        """The shape of a whole scenario."""
        return cls.of(Scenario)

    @classmethod
    def of(cls, model: type[BaseModel]) -> Shape:
        """The shape of a whole document."""
        schema = model.model_json_schema(schema_generator=_Plain)
        return cls(schema, schema["$defs"])

    @property
    def kinds(self) -> dict[str, Shape]:
        """The alternatives of a part that has a `kind`, by kind; empty for any other."""
        mapping = self._target.get("discriminator", {}).get("mapping", {})
        return {kind: Shape({"$ref": ref}, self.parts) for kind, ref in mapping.items()}

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys of a part; empty for a value, and for a part whose kind is not chosen."""
        return tuple(self._target.get("properties", ()))

    @property
    def choices(self) -> tuple[str, ...]:
        """The words that are allowed here, if it is a choice of words."""
        if self.kinds:
            return tuple(self.kinds)
        const = (self._target["const"],) if "const" in self._target else ()
        return tuple(map(str, self._target.get("enum", const)))

    @property
    def default(self) -> Any:
        """What stands here when nothing is given; ABSENT where something must be."""
        return self.schema.get("default", ABSENT)

    @property
    def description(self) -> str:
        """The unit and meaning."""
        return str(self.schema.get("description", ""))

    def child(self, key: str | int) -> Shape | None:
        """The shape of a key or of a list's items; None where there is none."""
        if self.kinds and key == "kind":
            return Shape({"type": "string", "enum": list(self.kinds)}, self.parts)
        for option in self._target.get("anyOf", [self._target]):
            below = option.get("items") if isinstance(key, int) else option.get("properties")
            if below is not None:
                found = below if isinstance(key, int) else below.get(key)
                return None if found is None else Shape(found, self.parts)
        return None

    def of_kind(self, value: Any) -> Shape:
        """Itself, or the alternative that `value` chooses by its `kind`."""
        kind = value.get("kind") if isinstance(value, dict) else None
        return self.kinds.get(kind, self) if isinstance(kind, str) else self

    def at(self, path: KeyPath, data: Any) -> Shape | None:
        """The shape at `path`, kinds chosen as `data` does; None where nothing may stand."""
        shape: Shape | None = self
        for key in path:
            shape = shape.of_kind(data).child(key) if shape else None
            data = lookup(data, (key,))
        return shape

    @property
    def words(self) -> str:
        """What is allowed here: "a number > 0", "a list of numbers", "one of: rk4, euler"."""
        if self.kinds:
            return f"keys with kind one of: {', '.join(self.kinds)}"
        if self.keys:
            return f"the keys {', '.join(self.keys)}"
        return " or ".join(_words(option) for option in self._target.get("anyOf", [self._target]))

    @property
    def _target(self) -> Mapping[str, Any]:
        options = self.schema.get("anyOf", ())
        group = options[0] if len(options) == 2 and options[1] == {"type": "null"} else self.schema
        ref = group.get("$ref", self.schema.get("$ref"))
        return self.parts[ref.rsplit("/", 1)[-1]] if ref else self.schema


def lookup(data: Any, path: KeyPath) -> Any:
    """The value at `path` of nested dicts and lists; ABSENT when there is none."""
    for part in path:
        if isinstance(data, dict):
            data = data.get(part, ABSENT)
        elif isinstance(data, list) and isinstance(part, int) and 0 <= part < len(data):
            data = data[part]
        else:
            return ABSENT
    return data


def _words(schema: Mapping[str, Any], plural: bool = False) -> str:
    if "enum" in schema or "const" in schema:
        return "one of: " + ", ".join(map(str, schema.get("enum", [schema.get("const")])))
    if "pattern" in schema:
        return "a name"
    if "type" not in schema:
        return "groups of keys" if plural else "a group of keys"
    if schema["type"] == "array":
        noun = "lists of" if plural else "a list of"
        return f"{noun} {_count(schema)}{_words(schema['items'], plural=True)}"
    return _NOUNS[schema["type"]][plural] + _range(schema)


def _count(schema: Mapping[str, Any]) -> str:
    least, most = schema.get("minItems", 0), schema.get("maxItems")
    if most is not None:
        return f"{least} to {most} "
    return f"{least} or more " if least > 1 else ""


def _range(schema: Mapping[str, Any]) -> str:
    if "minimum" in schema and "maximum" in schema:
        return f" from {schema['minimum']} to {schema['maximum']}"
    signs = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}
    bounds = [f"{sign} {schema[key]}" for key, sign in signs.items() if key in schema]
    return " " + " and ".join(bounds) if bounds else ""
