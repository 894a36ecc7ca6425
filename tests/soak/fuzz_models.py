"""Fuzzed: the text of an MJCF; what is let through is compiled and makes a step."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco

from dnnmso_mj.plant import Mjcf, build_spec, compile_spec
from dnnmso_mj.scenario import Plant
from dnnmso_mj.scene import Scene

MAX_LEN = 2500
SMALL = """<mujoco><option><flag contact="disable"/></option><worldbody><body name="link1">
<joint name="j" axis="0 1 0"/><geom name="g"
type="capsule" fromto="0 0 0 1 0 0" size="0.05"/></body></worldbody><actuator><motor name="m"
joint="j"/></actuator></mujoco>"""
TAGS = (
    "mujoco", "worldbody", "body", "joint", "geom", "site", "inertial", "actuator", "motor",
    "general", "default", "option", "flag", "compiler", "size", "asset", "mesh", "hfield", "skin",
    "texture", "material", "include", "frame", "replicate", "composite", "flexcomp", "attach",
    "model", "plugin", "instance", "config", "extension", "tendon", "fixed", "spatial", "equality",
    "weld", "connect", "contact", "exclude", "pair", "sensor", "keyframe", "key", "custom",
    "numeric", "text", "tuple", "visual", "statistic", "freejoint", "camera", "light", "deformable",
    "flex",
)  # fmt: skip
ATTRIBUTES = (
    "name", "class", "childclass", "type", "pos", "quat", "axisangle", "euler", "fromto", "size",
    "mass", "density", "axis", "range", "limited", "joint", "gear", "ctrlrange", "count", "offset",
    "sep", "file", "dir", "meshdir", "assetdir", "timestep", "gravity", "integrator", "inertia",
    "diaginertia", "fullinertia", "armature", "damping", "stiffness", "ref", "springref", "vertex",
    "face", "scale", "nrow", "ncol", "elevation", "content_type", "builtin", "width", "height",
    "prefix", "body1", "body2", "model", "plugin", "instance", "key", "value", "data", "nconmax",
    "memory", "nuserdata", "user", "solver", "iterations", "group", "rgba", "material", "mesh",
    "angle", "autolimits", "coordinate", "eulerseq", "inertiafromgeom", "balanceinertia",
    "boundmass", "spacing", "dim", "radius", "node", "element", "curve", "initial", "vertcount",
)  # fmt: skip
VALUES = (
    "0.1", "0.5", "2", "0.1 0.2 0.3", "0 1 0", "0.7 0 0.7 0", "x1", "x2",
    "0", "1", "-1", "nan", "inf", "1e308", "1e-320", "1e9", "20000", "2147483648", "-2147483648",
    "0 0 0", "1 0 0 0", "0 0 1", "1 2 3 4 5 6", "true", "false", "auto", "j", "g", "m", "link1",
    "sphere", "box", "mesh", "hfield", "capsule", "plane", "ball", "free", "slide", "hinge", "../x",
    "/etc/passwd", "x.obj", "x.stl", "mujoco.elasticity.cable", "", "a" * 300, "1 " * 200,
)  # fmt: skip
KNOWN = {  # what an element usually has
    "body": ("name", "pos", "quat", "axisangle", "euler", "childclass", "mocap", "gravcomp"),
    "joint": (
        "name",
        "type",
        "axis",
        "pos",
        "range",
        "limited",
        "armature",
        "ref",
        "class",
        "damping",
    ),
    "geom": ("name", "type", "size", "pos", "fromto", "mass", "density", "rgba", "mesh", "class"),
    "site": ("name", "pos", "size", "type", "quat"),
    "inertial": ("pos", "mass", "diaginertia", "fullinertia", "quat"),
    "motor": ("name", "joint", "gear", "ctrlrange", "group", "class"),
    "option": ("timestep", "gravity", "integrator", "iterations", "solver"),
    "compiler": ("angle", "coordinate", "balanceinertia", "boundmass", "eulerseq", "autolimits"),
    "replicate": ("count", "offset", "euler", "sep"),
    "frame": ("pos", "quat", "euler"),
    "mesh": ("name", "vertex", "face", "scale", "file", "builtin", "inertia", "params"),
    "hfield": ("name", "nrow", "ncol", "size", "elevation", "file"),
    "texture": ("name", "type", "builtin", "width", "height", "file", "rgb1"),
    "default": ("class",),
    "numeric": ("name", "size", "data"),
    "key": ("name", "time", "qpos", "qvel"),
    "light": ("name", "pos", "dir"),
    "camera": ("name", "pos", "mode", "target"),
}
_MARKS = ("/>", "&lt;", "<!DOCTYPE", "<!ENTITY a '", "&a;", "<![CDATA[", "<?xml encoding='", "<!--")
WORDS = [*(f"<{tag}" for tag in TAGS), *(f' {name}="' for name in ATTRIBUTES), *VALUES, *_MARKS]


def seeds(work: Path) -> list[bytes]:
    folder = Path(__file__).parents[2] / "models"
    return [SMALL.encode(), *(file.read_bytes() for file in folder.glob("*.xml")), *_odd()]


def _odd() -> list[bytes]:
    """Small models of one trait each."""
    inside = (
        '<replicate count="3" offset="1 0 0"><geom size="0.1"/></replicate>',
        '<composite type="cable" count="5 1 1" initial="none" curve="s" size="1"/>',
        '<frame euler="0 0 1"><geom type="box" size="1 1 1"/></frame>',
        '<flexcomp name="f" type="grid" count="3 3 1" spacing="1 1 1" radius="0.1" dim="2"/>',
        '<body mocap="true"><geom size="1"/></body>',
    )
    before = (
        '<asset><mesh name="q" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>',
        '<asset><hfield name="h" nrow="3" ncol="3" size="1 1 1 1"/></asset>',
        '<default><default class="c"><geom size="0.1"/></default></default>',
        '<option timestep="0.01" integrator="RK4"><flag contact="disable"/></option>',
        '<compiler angle="radian" meshdir="." balanceinertia="true"/>',
        '<include file="other.xml"/>',
        '<extension><plugin plugin="mujoco.elasticity.cable"/></extension>',
        '<size memory="1M" nuserdata="4"/>',
    )
    models = [SMALL.replace("<worldbody>", f"<worldbody>{part}") for part in inside]
    models += [SMALL.replace("<worldbody>", f"{part}<worldbody>") for part in before]
    return [model.encode() for model in models]


def strategy() -> Any:
    """Trees of known elements with known attributes, around a model that is whole."""
    from hypothesis import strategies as st

    attributes = st.dictionaries(st.sampled_from(ATTRIBUTES), st.sampled_from(VALUES), max_size=3)

    def element(children: Any) -> Any:
        return st.builds(_element, st.sampled_from(TAGS), attributes, children)

    tree = st.recursive(
        element(st.just([])), lambda c: element(st.lists(c, max_size=3)), max_leaves=6
    )
    return st.builds(_planted, tree, st.sampled_from(("worldbody", "mujoco", "body")))


def _element(tag: str, attributes: dict[str, str], children: list[Any]) -> ElementTree.Element:
    element = ElementTree.Element(tag, attributes)
    element.extend(children)
    return element


def _planted(tree: ElementTree.Element, where: str) -> bytes:
    root = ElementTree.fromstring(SMALL)
    next(root.iter(where)).insert(0, tree)
    return ElementTree.tostring(root)


def mutate(data: bytes, rng: random.Random, raw: Callable[[bytes, int], bytes]) -> bytes:
    """Change an element of the tree, if it is one."""
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError):
        return bytes(raw(data, MAX_LEN))
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        here = rng.choice(list(root.iter()))
        rng.choice((_set, _set, _change, _change, _drop, _add, _cut, _copy, _copy, _rename))(
            here, rng
        )
    return ElementTree.tostring(root)


def _set(here: ElementTree.Element, rng: random.Random) -> None:
    here.set(_attribute(here.tag, rng), rng.choice(VALUES))


def _attribute(tag: str, rng: random.Random) -> str:
    return rng.choice(ATTRIBUTES if rng.random() < 0.1 else KNOWN.get(tag, ATTRIBUTES))


def _change(here: ElementTree.Element, rng: random.Random) -> None:
    here.set(rng.choice([*here.attrib] or ["name"]), rng.choice(VALUES))


def _drop(here: ElementTree.Element, rng: random.Random) -> None:
    here.attrib.pop(rng.choice([*here.attrib] or ["name"]), None)


def _add(here: ElementTree.Element, rng: random.Random) -> None:
    tag = rng.choice(TAGS if rng.random() < 0.2 else [*KNOWN])
    part = ElementTree.SubElement(here, tag)
    for _ in range(rng.randrange(4)):
        _set(part, rng)


def _cut(here: ElementTree.Element, rng: random.Random) -> None:
    if len(here):
        here.remove(rng.choice(list(here)))


def _copy(here: ElementTree.Element, rng: random.Random) -> None:
    """A copy of one of its children, or of itself, inside; with names of its own."""
    copy = ElementTree.fromstring(ElementTree.tostring(rng.choice([*here, here])))
    for number, part in enumerate(copy.iter()):
        if "name" in part.attrib:
            part.set("name", f"copy{number}{rng.randrange(1000)}")
    here.append(copy)


def _rename(here: ElementTree.Element, rng: random.Random) -> None:
    here.tag = rng.choice(TAGS if rng.random() < 0.2 else [*KNOWN])


CHANGES = (
    _set,
    _set,
    _set,
    _change,
    _change,
    _change,
    _drop,
    _add,
    _add,
    _cut,
    _copy,
    _copy,
    _rename,
)


def target(work: Path) -> Any:
    plants = (Plant(masses=None, lengths=None), Plant())
    file = work / "model.xml"

    def tried(data: bytes) -> None:
        file.write_bytes(data)
        plant = plants[data[-1] % 2 if data else 0]
        model = compile_spec(build_spec(plant, 1e-3, Mjcf.read(file)), "model.xml")
        Scene(model).urdf()
        mujoco.mj_step(model, mujoco.MjData(model))

    return tried
