"""Mathematics without scripts: what stands between dollars becomes MathML, which browsers draw.

The font, STIX Two Math (OFL), comes out of the package ziamath, so that a formula looks the same on
every machine.
"""

from __future__ import annotations

import html
import re
from importlib.resources import files as resources
from itertools import pairwise
from typing import Any
from xml.etree import ElementTree

from latex2mathml.converter import convert_to_element
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

FORMULA = re.compile(r'<(span|div) class="arithmatex">(.*?)</\1>', re.DOTALL)
NUMBER = re.compile(r"\\tag\{(.*?)\}")
DISPLAY = {"div": "block", "span": "inline"}
CLOSING = {")", "]", "‖", "|"}
ACCENTS = {"^": "ˆ", "~": "˜", "˙": "˙", "¨": "¨", "¯": "¯"}
FONT = "STIXTwoMath-Regular.ttf"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the font, beside the style sheet that names it."""
    font = resources("ziamath").joinpath("fonts", FONT).read_bytes()
    files.append(File.generated(config, f"style/{FONT}", content=font))
    return files


def on_page_content(content: str, **_: Any) -> str:
    """Draw every formula of a page."""
    return FORMULA.sub(_draw, content)


def _draw(formula: re.Match[str]) -> str:
    tag, text = formula.groups()
    tex = html.unescape(text).strip()[2:-2]  # without \( and \), or \[ and \]
    number = NUMBER.search(tex)
    drawn = _mended(convert_to_element(NUMBER.sub("", tex), display=DISPLAY[tag]))
    if "\\" in drawn or "&amp;" in drawn:
        raise ValueError(f"no MathML for a part of {tex!r}: {drawn}")
    beside = f'<span class="number">({number[1]})</span>' if number else ""
    return f'<{tag} class="formula">{drawn}{beside}</{tag}>'


def _mended(root: ElementTree.Element) -> str:
    """What the converter leaves to better browsers.

    Accents as accents, close to their letters, and a minus that follows a sign as the sign of what
    comes after it.
    """
    for part in root.iter():
        part.text = html.unescape(part.text or "")
    for over in root.iter("mover"):
        accent = over[1]
        if accent.text in ACCENTS:
            over.set("accent", "true")
            accent.text, accent.attrib = ACCENTS[accent.text], {"stretchy": "false"}
    for row in root.iter():
        for before, sign in pairwise(row):
            if sign.text == "−" and before.tag == "mo" and before.text not in CLOSING:
                sign.set("form", "prefix")
    return ElementTree.tostring(root, encoding="unicode")
