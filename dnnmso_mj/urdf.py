"""URDF text of a scene, for every viewer and library that reads no MJCF."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING
from xml.etree import ElementTree as Xml

import numpy as np

from dnnmso_mj.rotations import IDENTITY, matrix, rpy

if TYPE_CHECKING:
    from dnnmso_mj.scene import Geom, Inertial, Joint, Link

Array = np.ndarray


def urdf_text(links: Sequence[Link], geoms: Sequence[Geom]) -> str:
    """Links, joints, shapes and masses as URDF.

    Args:
        links: the tree, parents first; the root link is "world".
        geoms: the shapes; a capsule becomes a cylinder and two spheres, an ellipsoid a box.
    """
    robot = Xml.Element("robot", name="robot")
    for name, inertial in [("world", None), *((link.name, link.inertial) for link in links)]:
        element = Xml.SubElement(robot, "link", name=name)
        if inertial:
            _add_inertial(element, inertial)
        for geom in geoms:
            if geom.body == name:
                _add_visuals(element, geom)
    for link in links:
        _add_joint(robot, link)
    Xml.indent(robot)
    return Xml.tostring(robot, encoding="unicode", xml_declaration=True)


def _add_inertial(link: Xml.Element, inertial: Inertial) -> None:
    element = Xml.SubElement(link, "inertial")
    _add_origin(element, inertial.com, IDENTITY)
    Xml.SubElement(element, "mass", value=repr(inertial.mass))
    (ixx, ixy, ixz), (_, iyy, iyz), (_, _, izz) = inertial.inertia.tolist()
    entries = {"ixx": ixx, "ixy": ixy, "ixz": ixz, "iyy": iyy, "iyz": iyz, "izz": izz}
    Xml.SubElement(element, "inertia", {name: repr(value) for name, value in entries.items()})


def _add_visuals(link: Xml.Element, geom: Geom) -> None:
    for k, (tag, attributes, along_z) in enumerate(_solids(geom)):
        visual = Xml.SubElement(link, "visual", name=geom.name if k == 0 else f"{geom.name}_{k}")
        axis = matrix(geom.quat_xyzw)[:, 2]
        _add_origin(visual, geom.xyz + along_z * axis, geom.quat_xyzw)
        Xml.SubElement(Xml.SubElement(visual, "geometry"), tag, attributes)
        # A colour can be given only once under one name, so each geom names its own material.
        material = Xml.SubElement(visual, "material", name=f"{geom.body}_{geom.name}")
        Xml.SubElement(material, "color", rgba=_numbers(geom.rgba))


def _solids(geom: Geom) -> Iterator[tuple[str, dict[str, str], float]]:
    """The URDF solids of a geom: tag, attributes, and place along the geom's own z (m)."""
    a, b, c = geom.size
    match geom.shape:
        case "sphere":
            yield "sphere", {"radius": repr(a)}, 0.0
        case "cylinder" | "capsule":
            yield "cylinder", {"radius": repr(a), "length": repr(2 * b)}, 0.0
            if geom.shape == "capsule":
                yield "sphere", {"radius": repr(a)}, b
                yield "sphere", {"radius": repr(a)}, -b
        case "box" | "ellipsoid":
            yield "box", {"size": _numbers((2 * a, 2 * b, 2 * c))}, 0.0


def _add_joint(robot: Xml.Element, link: Link) -> None:
    joint = link.joint
    name = joint.name if joint else f"{link.name}_fixed"
    element = Xml.SubElement(robot, "joint", name=name, type=_joint_type(joint))
    _add_origin(element, link.xyz, link.quat_xyzw)
    Xml.SubElement(element, "parent", link=link.parent)
    Xml.SubElement(element, "child", link=link.name)
    if not joint:
        return
    Xml.SubElement(element, "axis", xyz=_numbers(joint.axis))
    if _joint_type(joint) != "continuous":
        low, high = joint.limits or (-math.inf, math.inf)
        # URDF demands an effort and a velocity limit here; the model has none to give.
        limits = {"lower": low, "upper": high, "effort": math.inf, "velocity": math.inf}
        finite = {key: repr(float(np.clip(x, -1e9, 1e9))) for key, x in limits.items()}
        Xml.SubElement(element, "limit", finite)


def _joint_type(joint: Joint | None) -> str:
    if joint is None:
        return "fixed"
    if joint.kind == "slide":
        return "prismatic"
    return "revolute" if joint.limits else "continuous"


def _add_origin(parent: Xml.Element, xyz: Array, quat_xyzw: Array) -> None:
    Xml.SubElement(parent, "origin", xyz=_numbers(xyz), rpy=_numbers(rpy(quat_xyzw)))


def _numbers(values: Sequence[float] | Array) -> str:
    return " ".join(repr(float(value)) for value in values)
