"""How one run of several is told from the others."""

from __future__ import annotations

from dataclasses import dataclass

from dnnmso_mj.viewer.plot import BROAD, Line, Rgb, lighter

Point = tuple[float, float, float]

# Far apart in hue and alike in lightness, so that none of two runs draws the eye.
RUN_COLORS: tuple[Rgb, ...] = (
    (66, 150, 250),
    (255, 150, 50),
    (80, 200, 130),
    (240, 90, 110),
    (180, 140, 245),
    (230, 200, 80),
    (80, 200, 210),
    (235, 130, 200),
)


@dataclass(frozen=True)
class Look:
    """What sets a run apart; by default nothing, as it stands alone.

    Args:
        name: of the run, added to the name of each of its lines.
        color: of all its lines and of its arm; None: each joint and each layer has its own.
        desired: whether its desired arm and lines that it has in common with others are shown.
        offset: where its arm stands (m).
    """

    name: str = ""
    color: Rgb | None = None
    desired: bool = True
    offset: Point = (0.0, 0.0, 0.0)

    def label(self, name: str) -> str:
        """The name of a line in the legend."""
        return f"{name} · {self.name}" if self.name else name

    def line_color(self, line: Line) -> Rgb:
        """A line's own colour, or the run's: from full to half white over joints and layers."""
        if self.color is None:
            return line.color
        shade = lighter(self.color, 0.55 * line.place)
        return lighter(shade, 0.5) if line.width == BROAD else shade
