"""What a scenario takes from outside this package: code that it names, and settings for it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from dnnmso_mj.scenario.fields import Strict, refusal


def _plain(value: dict[str, Any]) -> dict[str, Any]:
    """The value with lists for tuples, so that it is what a log gives back.

    Raises:
        PydanticCustomError: a value that YAML has no word for.
    """
    problems = list(_problems(value, ""))
    if problems:
        raise refusal(*problems)
    copied: dict[str, Any] = _copied(value)
    return copied


def _problems(value: Any, path: str) -> Iterator[tuple[str, str]]:
    if isinstance(value, float) and not math.isfinite(value):
        yield path, "is not finite; allowed: finite numbers"
    elif isinstance(value, dict):
        for key, below in value.items():
            yield from _problems(below, f"{path}.{key}".lstrip("."))
    elif isinstance(value, list | tuple):
        for k, below in enumerate(value):
            yield from _problems(below, f"{path}.{k}")
    elif value is not None and not isinstance(value, bool | int | float | str):
        yield path, f"is of {type(value).__name__}; allowed: what YAML can write"


def _copied(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _copied(below) for key, below in value.items()}
    return [_copied(below) for below in value] if isinstance(value, list | tuple) else value


Python = Annotated[str, Field(min_length=1)]
Settings = Annotated[dict[str, Any], AfterValidator(_plain)]


class External(Strict):
    """A controller from outside this package; see docs/extending.md."""

    kind: Literal["external"]
    """Code of your own."""
    python: Python
    """module:Name, file.py:Name from this file, or an entry point of dnnmso_mj.controllers."""
    settings: Settings = Field(default_factory=dict)
    """Arguments by name."""


class ExternalReference(Strict):
    """A motion from outside this package; see docs/extending.md."""

    kind: Literal["external"]
    """A function of your own."""
    python: Python
    """module:name, file.py:name from this file, or an entry point of dnnmso_mj.references."""
    settings: Settings = Field(default_factory=dict)
    """Arguments by name."""


class ExternalImperfection(Strict):
    """An imperfection from outside this package; see docs/extending.md."""

    python: Python
    """module:Name, file.py:Name from this file, or an entry point of dnnmso_mj.imperfections."""
    settings: Settings = Field(default_factory=dict)
    """Arguments by name."""
