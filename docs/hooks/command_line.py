"""The command-line reference: made of the commands themselves, where a page asks for it."""

from __future__ import annotations

import re
from typing import Any

import typer
from typer.cli import get_docs_for_click

from dnnmso_mj.cli import app

PLACE = "<!-- make docs: command line -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put every command, its arguments and options, in their place."""
    return markdown.replace(PLACE, _commands()) if PLACE in markdown else markdown


def _commands() -> str:
    command = typer.main.get_command(app)
    context = typer.Context(command, info_name="dnnmso")
    text = get_docs_for_click(obj=command, ctx=context, name="dnnmso")
    whole, *commands = re.split(r"^(?=## )", text, flags=re.MULTILINE)
    names = [re.match(r"## `dnnmso (.+)`", text)[1] for text in commands]  # type: ignore[index]
    # Typer cuts the list of commands to the width of a terminal: each has its section below.
    options = whole[whole.index("**Usage**") : whole.index("**Commands**")]
    links = " · ".join(f"[`{name}`](#{name})" for name in names)
    sections = [
        text.replace("\n", f" {{ #{name} }}\n", 1)
        for name, text in zip(names, commands, strict=True)
    ]
    return "\n".join([links, "", options, *sections])
