"""JSON of a log: refused when it is larger than what is written, before it is parsed."""

from __future__ import annotations

import json
from typing import Any

from dnnmso_mj.log import limits


def check_json(text: str) -> None:
    """Refuse a text that would take far more memory than it is long.

    Raises:
        ValueError: it is too long, or has too many values.
    """
    values = sum(map(text.count, "[{,"))
    if len(text) > limits.JSON_TEXT or values > limits.JSON_VALUES:
        raise ValueError(
            f"of {len(text)} characters and about {values} values; allowed: {limits.JSON_TEXT} "
            f"and {limits.JSON_VALUES}"
        )


def read_json(text: str) -> Any:
    """The value of a text.

    Raises:
        ValueError: it is no JSON, too large or nested too deeply.
    """
    check_json(text)
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
