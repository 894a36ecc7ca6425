"""Notebooks as pages: their words and code, without what running them would show."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

NOTEBOOKS = Path(__file__).parents[2] / "notebooks"
HOW = "This page is `notebooks/{}`: open it in Jupyter to run it and to see its figures.\n"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each notebook."""
    for file in sorted(NOTEBOOKS.glob("*.ipynb")):
        cells = json.loads(file.read_text(encoding="utf-8"))["cells"]
        title, *rest = map(_markdown, cells)
        text = "\n".join([title, HOW.format(file.name), *rest])
        files.append(File.generated(config, f"notebooks/{file.stem}.md", content=text))
    return files


def _markdown(cell: dict[str, Any]) -> str:
    source = "".join(cell["source"])
    return f"```python\n{source}\n```\n" if cell["cell_type"] == "code" else f"{source}\n"
