"""A report as data, and the one page that is made of it."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dnnmso_mj.wording import clean

FOLDER = Path(__file__).parent


@dataclass(frozen=True)
class TableBlock:
    """A table; the first column names its rows."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    kind: Literal["table"] = "table"


@dataclass(frozen=True)
class FigureBlock:
    """A picture (PNG) with a caption that says what is to be seen."""

    caption: str
    png: bytes
    kind: Literal["figure"] = "figure"

    @property
    def source(self) -> str:
        """The picture inside the page."""
        return f"data:image/png;base64,{base64.b64encode(self.png).decode()}"


@dataclass(frozen=True)
class TextBlock:
    """A long text of a file, shown when asked for."""

    caption: str
    text: str
    kind: Literal["text"] = "text"


Block = TableBlock | FigureBlock | TextBlock


@dataclass(frozen=True)
class Section:
    """What one file says.

    Args:
        title: for people.
        facts: what was run and with what: name, text.
        blocks: in the order of reading.
        metrics: names of the metrics that are shown.
        notes: how to read the numbers.
    """

    title: str
    facts: Sequence[tuple[str, str]]
    blocks: Sequence[Block]
    metrics: Sequence[str] = ()
    notes: Sequence[str] = ()


def render(title: str, command: str, sections: Sequence[Section]) -> str:
    """The page as HTML: nothing in it is fetched, run, or taken for markup.

    Args:
        title: of the page.
        command: that makes it.
        sections: one a file.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    from dnnmso_mj.report.definitions import METRICS

    environment = Environment(
        loader=FileSystemLoader(FOLDER),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["line"] = clean
    shown = [name for name in METRICS if any(name in section.metrics for section in sections)]
    notes = dict.fromkeys(note for section in sections for note in section.notes)
    return environment.get_template("page.html.jinja").render(
        title=title,
        command=command,
        sections=sections,
        definitions=[(name, *METRICS[name]) for name in shown],
        notes=list(notes),
    )
