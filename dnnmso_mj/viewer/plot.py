"""What a plot is made of: named, coloured lines over the columns of a run, and levels.

The builders at the end give lines of joints and of layers the same colours in all plots.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from dnnmso_mj.trace import Array, Trace

Rgb = tuple[int, int, int]
Corner = Literal["LeftTop", "LeftBottom", "RightTop", "RightBottom"]
Values = Callable[[Trace], Array]  # a stretch of N ticks -> (N,); a NaN leaves a gap

TIMELINE = "time"  # what every line, pose and event is placed on: simulated time
JOINT_COLORS: tuple[Rgb, ...] = (
    (66, 150, 250),
    (255, 150, 50),
    (80, 200, 130),
    (240, 90, 110),
    (180, 140, 245),
    (230, 200, 80),
    (80, 200, 210),
)
WHITE: Rgb = (235, 235, 235)
GREY: Rgb = (150, 150, 150)
RED: Rgb = (235, 70, 70)
_FIRST_LAYER, _LAST_LAYER = np.array([240, 110, 210]), np.array([250, 230, 90])
THIN, NORMAL, BROAD = 1.0, 1.5, 4.0  # points; a broad line is seen on both sides of one over it


@dataclass(frozen=True)
class Line:
    """One value a tick; lines of one name have one entry in the legend."""

    name: str
    values: Values
    color: Rgb
    width: float = NORMAL
    place: float = 0.0  # among its like: 0 for the first joint or layer, 1 for the last
    # What a value is held against is its context; the reference is the same for several runs.
    role: Literal["value", "context", "shared"] = "value"


@dataclass(frozen=True)
class Level:
    """A value that holds for the whole run, such as a limit."""

    name: str
    value: float
    color: Rgb


@dataclass(frozen=True)
class Plot:
    """Lines drawn over one another, the first at the bottom; `path` is unique among all plots."""

    path: str
    title: str
    lines: tuple[Line, ...]
    levels: tuple[Level, ...] = ()
    y_range: tuple[float, float] | None = None  # None: whatever the lines need
    # What a pixel shows of the many ticks that fall on it. Of a logarithm the low peaks are mere
    # zero crossings. Never the mean: it would hide the peaks of torque and of compute time.
    pixel: Literal["extremes", "largest"] = "extremes"
    legend: Corner | None = None  # None: the lines have the colours of another plot's


def joint_color(joint: int) -> Rgb:
    """The colour of a joint (from 0), the same in every plot and on the arm."""
    return JOINT_COLORS[joint % len(JOINT_COLORS)]


def places(count: int) -> list[float]:
    """`Line.place` of so many lines."""
    return [k / max(count - 1, 1) for k in range(count)]


def lighter(color: Rgb, share: float = 0.6) -> Rgb:
    """A colour with this share of white."""
    red, green, blue = (round((1.0 - share) * c + share * 255) for c in color)
    return red, green, blue


def darker(color: Rgb) -> Rgb:
    """A colour for white words to stand on; the viewer darkens bands once more."""
    red, green, blue = (round(0.7 * c) for c in color)
    return red, green, blue


def entry(name: str, k: int) -> Values:
    """Entry k of a column of vectors."""
    return lambda trace: trace[name][:, k]


def scalar(name: str) -> Values:
    """A column of numbers or flags."""
    return lambda trace: trace[name].astype(float)


def difference(name: str, other: str, k: int) -> Values:
    """Entry k of one column minus that of another."""
    return lambda trace: trace[name][:, k] - trace[other][:, k]


def distance(name: str, other: str, entries: slice) -> Values:
    """Euclidean distance of two columns in some of their entries."""
    return lambda trace: np.linalg.norm(trace[name][:, entries] - trace[other][:, entries], axis=1)


def log10(values: Values) -> Values:
    """log₁₀ of the magnitude; zero, which has none, becomes a gap."""

    def logarithm(trace: Trace) -> Array:
        magnitude = np.abs(values(trace))
        out: Array = np.full(magnitude.shape, np.nan)
        np.log10(magnitude, out=out, where=magnitude > 0.0)
        return out

    return logarithm


def log_plot(path: str, title: str, lines: tuple[Line, ...], legend: Corner | None = None) -> Plot:
    """A plot of logarithms."""
    return Plot(path, title, lines, pixel="largest", legend=legend)


def joints(label: str, n: int, values: Callable[[int], Values]) -> tuple[Line, ...]:
    """A line for each joint, in the joints' colours; `label` with {} for the joint's number."""
    return tuple(
        Line(label.format(j + 1), values(j), joint_color(j), place=place)
        for j, place in enumerate(places(n))
    )


def pale(lines: tuple[Line, ...]) -> tuple[Line, ...]:
    """The lines broad and in lighter colours, to lie under others."""
    return tuple(
        replace(line, color=lighter(line.color), width=BROAD, role="context") for line in lines
    )


def layers(count: int, values: Callable[[int], Values]) -> tuple[Line, ...]:
    """A line for each weight layer, from pink to yellow."""
    lines = []
    for k, place in enumerate(places(count)):
        color = ((1.0 - place) * _FIRST_LAYER + place * _LAST_LAYER).astype(int).tolist()
        lines.append(Line(f"layer {k + 1}", values(k), tuple(color), place=place))
    return tuple(lines)
