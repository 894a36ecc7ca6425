"""Mathematics without scripts: what stands between dollars becomes MathML, which browsers draw."""

from __future__ import annotations

import html
import re
from typing import Any

from latex2mathml.converter import convert

FORMULA = re.compile(r'<(span|div) class="arithmatex">(.*?)</\1>', re.DOTALL)


def on_page_content(content: str, **_: Any) -> str:
    """Draw every formula of a page."""
    return FORMULA.sub(_draw, content)


def _draw(formula: re.Match[str]) -> str:
    tag, text = formula.groups()
    tex = html.unescape(text).strip()[2:-2]  # without \( and \), or \[ and \]
    drawn = convert(tex, display="block" if tag == "div" else "inline")
    if "\\" in drawn:
        raise ValueError(f"no MathML for a part of {tex!r}: {drawn}")
    return f'<{tag} class="formula">{drawn}</{tag}>'
