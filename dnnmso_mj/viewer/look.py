"""How one run of several is told from the others."""

from __future__ import annotations

from dataclasses import dataclass

from dnnmso_mj.viewer.plot import JOINT_COLORS, Line, Rgb, lighter

Point = tuple[float, float, float]

# Far apart in hue and alike in lightness, so that none of two runs draws the eye.
RUN_COLORS = (*JOINT_COLORS, (235, 130, 200))
COMMON_COLOR: Rgb = (115, 115, 115)


@dataclass(frozen=True)
class Look:
    """What sets a run apart; by default nothing, as it stands alone.

    Args:
        name: of the run, which its lines have in the legend.
        color: of all its lines and of its arm; None: each joint and each layer has its own.
        shared: whether it shows what it has in common with an earlier run: the desired motion.
        ghost: whether the desired arm moves with it.
        offset: where its arm stands (m).
    """

    name: str = ""
    color: Rgb | None = None
    shared: bool = True
    ghost: bool = True
    offset: Point = (0.0, 0.0, 0.0)

    def line_name(self, line: Line) -> str:
        """What the legend says."""
        if not self.name or line.role == "shared":
            return line.name
        return self.name if line.role == "value" else f"{self.name}, {line.name}"

    def line_color(self, line: Line) -> Rgb:
        """A line's own colour, or the run's: lighter from joint to joint, or layer to layer."""
        if self.color is None:
            return line.color
        if line.role == "shared":
            return COMMON_COLOR
        shade = lighter(self.color, 0.55 * line.place)
        return shade if line.role == "value" else lighter(shade, 0.5)
