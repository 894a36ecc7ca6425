"""JSON of a log: refused when it is larger than what is written, before it is parsed."""

from __future__ import annotations

import json
from typing import Any

from dnnmso_mj.log import limits


def check_json(text: str, most: int = limits.JSON_TEXT) -> None:
    """Refuse a text that would take far more memory than it is long.

    Raises:
        ValueError: it is too long, or has too many values.
    """
    values = sum(map(text.count, "[{,"))
    if len(text) > most or values > most // 10:
        raise ValueError(
            f"of {len(text)} characters and about {values} values; allowed: {most} and {most // 10}"
        )


def read_json(text: str, most: int = limits.JSON_TEXT) -> Any:
    """The value of a text.

    Args:
        text: JSON.
        most: characters; a tenth of it values.

    Raises:
        ValueError: it is no JSON, too large or nested too deeply.
    """
    check_json(text, most)
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
