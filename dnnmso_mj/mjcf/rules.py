"""What an MJCF may hold: elements of rigid robots, and numbers that MuJoCo can work with.

Left out is what runs code (plugins), what makes many bodies of one element (composite, flexcomp),
what reads further models (attach), and what computes for long while a model is compiled.
"""

from __future__ import annotations

import math
import re

from dnnmso_mj.mjcf.xml import MAX_DEPTH, Tag, below, refuse, walk

MAX_NUMBER = 1e10  # MuJoCo's own bound of what is plausible, mjMAXVAL
MAX_COPIES = 5000  # elements, each copy of <replicate> counted
MAX_BODIES = 1000  # copies counted; MuJoCo takes time that grows with their square
MAX_PIXELS = 8 * 1024 * 1024  # of all textures that are made or read
MAX_HEIGHTS = 1024 * 1024  # of all height fields
MAX_MEMORY = 64 * 1024 * 1024  # bytes that <size> asks for

WORLD = "mujoco worldbody body frame replicate inertial joint freejoint geom site camera light"
SETTINGS = "compiler option flag size statistic visual global quality headlight map scale rgba"
ASSETS = "default asset mesh hfield texture material layer"
MOTORS = "actuator general motor position velocity intvelocity orientation pid damper cylinder"
OTHERS = "contact pair exclude equality connect weld tendon spatial fixed pulley keyframe key"
CUSTOM = "custom numeric text tuple element dcmotor adhesion"
SENSORS = """
sensor touch accelerometer velocimeter gyro force torque magnetometer camprojection rangefinder
jointpos jointvel tendonpos tendonvel actuatorpos actuatorvel actuatorfrc jointactuatorfrc
tendonactuatorfrc ballquat ballangvel jointlimitpos jointlimitvel jointlimitfrc tendonlimitpos
tendonlimitvel tendonlimitfrc framepos framequat framexaxis frameyaxis framezaxis framelinvel
frameangvel framelinacc frameangacc subtreecom subtreelinvel subtreeangmom insidesite distance
normal fromto e_potential e_kinetic clock user
"""
ALLOWED = frozenset(" ".join((WORLD, SETTINGS, ASSETS, MOTORS, OTHERS, CUSTOM, SENSORS)).split())

# What one number may be; an attribute of several holds for each.
LIMITS: dict[tuple[str, str], tuple[float, float]] = {
    ("option", "timestep"): (1e-6, 1.0),
    **{
        ("option", f"{name}iterations"): (0, 10_000)
        for name in ("", "ls_", "noslip_", "ccd_", "sdf_")
    },
    ("option", "sdf_initpoints"): (0, 1000),
    **{("size", name): (-1, 100_000) for name in ("njmax", "nconmax", "nuserdata")},
    ("size", "nkey"): (-1, 1000),
    **{
        ("size", f"nuser_{name}"): (-1, 100)
        for name in ("actuator", "body", "cam", "geom", "jnt", "sensor", "site", "tendon")
    },
    ("size", "nstack"): (-1, MAX_MEMORY / 8),
    **{("global", name): (1, 10_000) for name in ("offwidth", "offheight")},
    **{("quality", name): (0, 1000) for name in ("numquads", "numslices", "numstacks")},
    ("quality", "offsamples"): (0, 64),
    ("quality", "shadowsize"): (0, 16_384),
    ("camera", "resolution"): (1, 10_000),
    ("mesh", "params"): (-1000, 128),
    ("mesh", "maxhullvert"): (-1, 100_000),
    ("numeric", "size"): (1, 10_000),
    ("user", "dim"): (1, 10_000),
    ("contact", "num"): (1, 1000),
    ("general", "actdim"): (-1, 100),
    ("texture", "width"): (0, 16_384),
    ("texture", "height"): (0, 100_000),
    ("texture", "nchannel"): (1, 4),
    ("hfield", "nrow"): (0, MAX_HEIGHTS),
    ("hfield", "ncol"): (0, MAX_HEIGHTS),
    ("replicate", "count"): (1, MAX_COPIES),
}
HISTORY = (0, 1000)  # samples that a sensor or a motor keeps

# Attributes that are refused wherever they stand, and what to do instead.
FORBIDDEN = {
    "content_type": "remove it; the file's ending says what it is",
    "passthrough": "remove it; files become a part of the model",
    "embed": "remove it; files become a part of the model",
}
FORBIDDEN_VALUES = {"sdf": "mesh, capsule, box …", "muscle": "motors"}

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.IGNORECASE)
_STRANGE = re.compile(r"[+-]?(nan(\(.*\)?)?|inf(inity)?|0x[0-9a-f.]+(p[+-]?\d+)?)", re.IGNORECASE)
# Cheap to look for in a long attribute: none of it, and every number is below MAX_NUMBER.
_SUSPECT = re.compile(r"nan|inf|0x|\d\.?e\+?\d|\d{10}", re.IGNORECASE)
_MEMORY = re.compile(r"(\d{1,15})([KMGTPE]?)")


def check_rules(root: Tag) -> None:
    """Refuse what a robot of ours has no use for, and what would take too long.

    Raises:
        ScenarioError: the first that is found.
    """
    if root.tag != "mujoco":
        raise refuse(root, "is no MJCF; allowed: <mujoco>")
    for tag in walk(root):
        _check_element(tag)
        for key in tag.attrib:
            _check_attribute(tag, key)
    _count(root)
    _check_grids(root)


def _check_element(tag: Tag) -> None:
    if tag.tag == "include":
        raise refuse(tag, "names another file; allowed: in a model that is read from a file")
    if tag.tag not in ALLOWED:
        raise refuse(
            tag, "is not let in; allowed: bodies, joints, geoms, sites, assets, motors, sensors …"
        )


def _check_attribute(tag: Tag, key: str) -> None:
    value = tag.get(key, "")
    if key in FORBIDDEN:
        raise refuse(tag, f"is not let in; {FORBIDDEN[key]}", key)
    if key.endswith("type") and value in FORBIDDEN_VALUES:
        raise refuse(tag, f"is not let in; allowed: {FORBIDDEN_VALUES[value]}", key)
    if (tag.tag, key) == ("size", "memory"):
        _check_memory(tag, value)
    elif _SUSPECT.search(value):
        for word in value.split():
            _check_number(tag, key, word)
    limits = HISTORY if key == "nsample" else LIMITS.get((tag.tag, key))
    if limits is not None:
        _check_range(tag, key, limits)


def _check_number(tag: Tag, key: str, word: str) -> None:
    if _STRANGE.fullmatch(word):
        raise refuse(tag, "is not finite, or not decimal; allowed: finite decimal numbers", key)
    if _NUMBER.fullmatch(word) and not abs(float(word)) <= MAX_NUMBER:
        raise refuse(tag, f"is out of range; allowed: -{MAX_NUMBER:g} to {MAX_NUMBER:g}", key)


def _check_range(tag: Tag, key: str, limits: tuple[float, float]) -> None:
    least, most = limits
    for word in tag.get(key, "").split() or [""]:
        number = float(word) if _NUMBER.fullmatch(word) else math.nan
        if not least <= number <= most:
            raise refuse(tag, f"is out of range; allowed: {least:g} to {most:g}", key)


def _check_memory(tag: Tag, value: str) -> None:
    found = _MEMORY.fullmatch(value.strip().upper())
    size = int(found[1]) << (10 * "_KMGTPE".index(found[2] or "_")) if found else 0
    if value.strip() != "-1" and not (found and size <= MAX_MEMORY):
        raise refuse(tag, f"asks for too much; allowed: -1, or up to {MAX_MEMORY >> 20}M", "memory")


def _count(root: Tag) -> None:
    """Each element as often as <replicate> copies it, from the outside in; and its depth."""
    elements = bodies = 0
    waiting = [(root, 1, 1)]
    while waiting:
        tag, copies, depth = waiting.pop()
        elements += copies
        bodies += copies * (tag.tag == "body")
        copies *= int(_number(tag, "count", 1.0)) if tag.tag == "replicate" else 1
        if depth > MAX_DEPTH:
            raise refuse(tag, f"is nested too deeply; allowed: {MAX_DEPTH} levels")
        if elements > MAX_COPIES or copies > MAX_COPIES:
            raise refuse(tag, f"makes too many elements; allowed: {MAX_COPIES}, copies counted")
        if bodies > MAX_BODIES:
            raise refuse(tag, f"makes too many bodies; allowed: {MAX_BODIES}, copies counted")
        waiting += [(part, copies, depth + 1) for part in below(tag)]


def _number(tag: Tag, key: str, default: float = 0.0) -> float:
    """The one number of an attribute."""
    words = tag.get(key, "").split()
    if not words:
        return default
    if len(words) > 1 or not _NUMBER.fullmatch(words[0]):
        raise refuse(tag, "is not one number; allowed: a decimal number", key)
    return float(words[0])


def _check_grids(root: Tag) -> None:
    """The numbers that textures and height fields are made of, in sum."""
    pixels = heights = 0.0
    for tag in walk(root):
        if tag.tag == "texture":
            width, height = (_number(tag, key) for key in ("width", "height"))
            pixels += max(width * height, 6 * width**2 if tag.get("type", "cube") != "2d" else 0)
        elif tag.tag == "hfield":
            heights += _number(tag, "nrow") * _number(tag, "ncol")
        if pixels > MAX_PIXELS:
            raise refuse(tag, f"makes too many pixels; allowed: {MAX_PIXELS} of all", "width")
        if heights > MAX_HEIGHTS:
            raise refuse(tag, f"makes too many heights; allowed: {MAX_HEIGHTS} of all", "nrow")
