"""What stands outside of docs/, on the site: links work here and where Markdown is read as it is.

CONTRIBUTING.md and CHANGELOG.md become pages, as notebooks do (notebooks.py). A line that is
nothing but a link to a section of README.md becomes that section. What else is linked to outside of
docs/ is copied under files/.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
README = "README.md"
PAGES = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#|/)([^)\s#]+)")
SECTION = re.compile(r"^\[[^\]]+\]\((?:\.\./)+README\.md#([a-z-]+)\)$", re.MULTILINE)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of the root, and each file that some page links to."""
    for source, name in PAGES.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, name, content=text))
    for page in list(files.documentation_pages()):
        for text, folder in _parts(page.content_string, page):
            for link in LINK.finditer(text):
                uri, source = _target(link[1], folder)
                if source and files.get_file_from_path(uri) is None:
                    files.append(File.generated(config, uri, abs_src_path=str(source)))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Put sections of README in place, and let every link lead to where the site has its target."""
    here = posixpath.dirname(page.file.src_uri) or "."
    parts = [
        LINK.sub(lambda link, of=folder: posixpath.relpath(_target(link[1], of)[0], here), text)
        for text, folder in _parts(markdown, page.file)
    ]
    return "".join(parts)


def _parts(markdown: str, page: File) -> Iterator[tuple[str, str]]:
    """A page's text and sections of README in it, each with the folder its links start from."""
    if page.src_uri in PAGES.values():
        own = ""
    else:
        own = posixpath.dirname(
            page.src_uri if _is_notebook(page.src_uri) else f"docs/{page.src_uri}"
        )
    for k, text in enumerate(SECTION.split(markdown)):
        yield (text, own) if k % 2 == 0 else (_section(text), "")


def _target(link: str, folder: str) -> tuple[str, Path | None]:
    """Where a link of a file in a folder leads on the site, and the file there if it is a copy."""
    place = posixpath.normpath(posixpath.join(folder, link))
    if place.startswith("docs/"):
        return place.removeprefix("docs/"), None
    if place in {README, *PAGES}:
        return PAGES.get(place, "index.md"), None
    if _is_notebook(place):
        return posixpath.splitext(place)[0] + ".md", None
    return f"files/{place}", ROOT / place


def _is_notebook(place: str) -> bool:
    return posixpath.dirname(place) == "notebooks"


def _section(anchor: str) -> str:
    """What README says under a heading."""
    for part in re.split(r"^## ", (ROOT / README).read_text(encoding="utf-8"), flags=re.MULTILINE):
        title, _, body = part.partition("\n")
        if re.sub(r"[^a-z]+", "-", title.lower()) == anchor:
            return body.strip()
    raise ValueError(f"{README} has no section {anchor}")
