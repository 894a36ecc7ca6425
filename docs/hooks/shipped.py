"""The page of the scenarios that ship: what each is, and all that it says."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

SCENARIOS = Path(__file__).parents[2] / "scenarios"
PLACE = "<!-- make docs: shipped scenarios -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put every shipped scenario and tuned controller in its place."""
    return markdown.replace(PLACE, "\n".join(_sections())) if PLACE in markdown else markdown


def _sections() -> Iterator[str]:
    for folder in (".", "literature", "controllers"):
        for file in sorted((SCENARIOS / folder).glob("*.yaml")):
            text = file.read_text(encoding="utf-8")
            described = re.search(r"^description: (.*)$", text, re.MULTILINE)
            yield f"## {file.relative_to(SCENARIOS).with_suffix('')}\n"
            yield f"{described[1]}\n" if described else ""
            yield f"```yaml\n{text}```\n"
