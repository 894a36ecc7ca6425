"""The kinds of values a scenario is made of, and the base of its parts."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, WithJsonSchema
from pydantic_core import PydanticCustomError


def refusal(*problems: tuple[str, str]) -> PydanticCustomError:
    """An error about several values: (key path below this part, what is wrong with it)."""
    text = "; ".join(f"{path} {problem}" for path, problem in problems)
    return PydanticCustomError("refused", "{text}", {"text": text, "problems": problems})


def as_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _vector(value: Any) -> Any:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return (value,) if is_number else as_tuple(value)


def _number_or_list(item: dict[str, Any]) -> WithJsonSchema:
    return WithJsonSchema({"anyOf": [item, {"type": "array", "items": item, "minItems": 1}]})


Finite = Annotated[float, Field(allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
# Beyond these, sums of squares of weights or gradients leave the range of floating point.
WeightScale = Annotated[float, Field(ge=1e-3, le=1e3, allow_inf_nan=False)]
# The length stands before the conversion, or the JSON Schema would say minLength for minItems.
Vector = Annotated[tuple[Finite, ...], Field(min_length=1), BeforeValidator(as_tuple)]
Positives = Annotated[tuple[Positive, ...], Field(min_length=1), BeforeValidator(as_tuple)]
Matrix = Annotated[tuple[Vector, ...], Field(min_length=1), BeforeValidator(as_tuple)]
# One number for all entries, or one for each; kept as a tuple and widened by `expand`.
PositiveEach = Annotated[
    tuple[Positive, ...],
    Field(min_length=1),
    BeforeValidator(_vector),
    _number_or_list({"type": "number", "exclusiveMinimum": 0}),
]
NonNegativeEach = Annotated[
    tuple[NonNegative, ...],
    Field(min_length=1),
    BeforeValidator(_vector),
    _number_or_list({"type": "number", "minimum": 0}),
]
# MuJoCo's own integrators take damping in; with more than this their stages overflow.
DampingEach = Annotated[
    tuple[Annotated[NonNegative, Field(le=1e9)], ...],
    Field(min_length=1),
    BeforeValidator(_vector),
    _number_or_list({"type": "number", "minimum": 0, "maximum": 1e9}),
]
FiniteEach = Annotated[
    tuple[Finite, ...],
    Field(min_length=1),
    BeforeValidator(_vector),
    _number_or_list({"type": "number"}),
]
CountEach = Annotated[
    tuple[Annotated[int, Field(ge=1)], ...],
    Field(min_length=1),
    BeforeValidator(_vector),
    _number_or_list({"type": "integer", "minimum": 1}),
]


def expand(values: tuple[float, ...], size: int) -> np.ndarray:
    """Widen one number to `size` entries; pass a full list through. Shape (size,)."""
    return np.full(size, values[0]) if len(values) == 1 else np.array(values, dtype=float)


class Strict(BaseModel):
    """Base of all parts: unknown keys, coercions and non-finite numbers are refused."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )
