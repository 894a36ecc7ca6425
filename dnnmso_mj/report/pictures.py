"""Figures of a report as PNG."""

from __future__ import annotations

from collections.abc import Callable

from matplotlib.figure import Figure

from dnnmso_mj.figures.drawing import house_style
from dnnmso_mj.plots import png_bytes
from dnnmso_mj.report.page import FigureBlock


def picture(caption: str, draw: Callable[[], Figure]) -> FigureBlock:
    """A figure, drawn in the house's style whatever the user's settings are."""
    with house_style():
        return FigureBlock(caption, png_bytes(draw()))
