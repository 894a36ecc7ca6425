"""The gate before MuJoCo: what it lets in, and what it refuses by name."""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path

import dm_control
import mujoco
import pytest

import dnnmso_mj
from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.mjcf import gate
from dnnmso_mj.mjcf.rules import MAX_BODIES
from dnnmso_mj.plant import Mjcf

PACKAGE = Path(dnnmso_mj.__file__).parent
THIRD_PARTY = Path(dm_control.__file__).parent / "third_party"
SUITE = Path(dm_control.__file__).parent / "suite"

# A robot as people write them: classes, visuals, sensors, keyframes, frames, textures.
ARM = """\
<mujoco model="arm">
  <compiler angle="degree" meshdir="parts" autolimits="true"/>
  <option timestep="0.002" integrator="implicitfast"><flag contact="disable"/></option>
  <size memory="1M" nuser_geom="2"/>
  <statistic center="0 0 1" extent="2"/>
  <visual><headlight ambient="0.4 0.4 0.4"/><global offwidth="1920" offheight="1080"/></visual>
  <default>
    <default class="arm"><joint axis="0 1 0" damping="0"/><geom contype="0"/></default>
  </default>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" width="512" height="3072"/>
    <texture name="grid" type="2d" builtin="checker" width="512" height="512"/>
    <material name="floor" texture="grid" texrepeat="5 5"/>
    <mesh name="wedge" vertex="0 0 0 0.4 0 0 0 0.2 0 0 0 0.1"/>
  </asset>
  <worldbody>
    <light pos="0 0 3"/><camera name="side" pos="0 -3 1" xyaxes="1 0 0 0 0 1"/>
    <geom type="plane" size="2 2 0.1" material="floor" contype="0" conaffinity="0"/>
    <replicate count="12" euler="0 0 30"><site pos="1 0 0" size="0.01"/></replicate>
    <frame pos="0 0 1">
      <body name="link1" childclass="arm">
        <joint name="joint1"/><geom type="capsule" fromto="0 0 0 1 0 0" size="0.05"/>
        <geom type="mesh" mesh="wedge"/><site name="tip" pos="1 0 0"/>
      </body>
    </frame>
  </worldbody>
  <contact><exclude body1="world" body2="link1"/></contact>
  <actuator><motor name="motor1" joint="joint1"/></actuator>
  <sensor><jointpos joint="joint1"/><framepos objtype="site" objname="tip"/></sensor>
  <keyframe><key name="home" qpos="0.5"/></keyframe>
</mujoco>
"""

BODY = '<body><joint name="j"/><geom size="0.1"/>{}</body>'


def compiled(mjcf: Mjcf) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(mjcf.checked)
    spec.modelfiledir = mjcf.folder
    return spec.compile()


def world(inside: str = "", before: str = "") -> str:
    return f"<mujoco>{before}<worldbody>{inside}</worldbody></mujoco>"


def test_a_robot_as_people_write_them_is_let_in_and_means_the_same() -> None:
    assert compiled(Mjcf(ARM)).nbody == 2
    same = mujoco.MjModel.from_xml_string(ARM)
    assert compiled(Mjcf(ARM)).body_inertia.tobytes() == same.body_inertia.tobytes()


@pytest.mark.parametrize(
    "model",
    [
        THIRD_PARTY / "kinova" / "jaco_arm.xml",
        THIRD_PARTY / "kinova" / "jaco_hand.xml",
        SUITE / "acrobot.xml",
        SUITE / "manipulator.xml",
        SUITE / "humanoid_CMU.xml",
    ],
    ids=lambda path: path.stem,
)
def test_models_of_others_are_let_in(model: Path) -> None:
    assert compiled(Mjcf.read(model)).nbody > 1


def test_lines_in_messages_of_mujoco_are_those_of_the_file() -> None:
    body = BODY.format('<site\n size="1"/>\n<geom sice="1"/>')
    text = "<!-- two\nlines -->\n" + world(body)
    with pytest.raises(ValueError, match="line 5"):
        mujoco.MjSpec.from_string(gate(text))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('<!DOCTYPE m [<!ENTITY a "b">]><mujoco model="&a;"/>', "DOCTYPE m"),
        ('<?xml version="1.0" encoding="utf-16"?><mujoco/>', 'encoding = "utf-16"; allowed: UTF-8'),
        ("<mujoco/><mujoco/>", "not XML: junk after document element"),
        ("<mujoco>&lol;</mujoco>", "not XML: undefined entity"),
        ("<mujoco>\0</mujoco>", "not XML"),
        ("<robot name='urdf'/>", "<robot>: is no MJCF"),
        ("<mujoco><body>" + "<body>" * 300, "nested too deeply; allowed: 200"),
        ("<mujoco>" + "<a/>" * 6000 + "</mujoco>", "too many elements; allowed: 5000"),
        (f'<mujoco model="{"m" * 1000}"/>', "very long word"),
        ('<mujoco model="a&#x202e;b"/>', "cannot be seen"),
        ('<mujoco><include file="a.xml"/></mujoco>', "<include>: names another file"),
        ('<mujoco><extension><plugin plugin="p"/></extension></mujoco>', "<extension>: is not let"),
        (world('<composite type="cable" count="9 1 1"/>'), "<composite>: is not let in"),
        (world('<flexcomp name="f" count="9 9 9"/>'), "<flexcomp>: is not let in"),
        (world('<attach model="m" prefix="p"/>'), "<attach>: is not let in"),
        (world(before='<asset><model file="m.xml"/></asset>'), "<model>: is not let in"),
        (world(before='<compiler><lengthrange mode="all"/></compiler>'), "<lengthrange>: is not"),
        (world('<geom type="sdf" mesh="m"/>'), 'type = "sdf": is not let in'),
        (world('<geom size="nan"/>'), 'size = "nan": is not finite'),
        (world('<geom size="1" pos="0 -INF 0"/>'), "is not finite"),
        (world('<geom size="nan(7)"/>'), "is not finite"),
        (world('<geom size="0x1p999"/>'), "not decimal"),
        (world('<geom size="1e999"/>'), "out of range; allowed: -1e"),
        (world(f'<geom size="1{"0" * 300}"/>'), "out of range"),
        *(
            (world(before=f'<option timestep="{value}"/>'), r"timestep = .*allowed: (1e-06|finite)")
            for value in ("0", "-1", "nan", "inf", "1e9", "", "x")
        ),
        (world(before='<option iterations="2000000000"/>'), "iterations = .*allowed: 0 to 10000"),
        (world(before='<size memory="9E"/>'), "memory = .*allowed: -1, or up to 64M"),
        (world(before='<size nuser_body="1000000"/>'), "nuser_body = .*allowed: -1 to 100"),
        (world('<replicate count="20000"><site/></replicate>'), "count = .*allowed: 1 to 5000"),
        (
            world('<replicate count="99"><replicate count="99"><site/></replicate></replicate>'),
            "too many elements; allowed: 5000, copies counted",
        ),
        (world("<body/>" * (MAX_BODIES + 1)), "too many bodies; allowed: 1000"),
        (
            world(before='<asset><texture type="2d" builtin="flat" width="9999" height="9999"/>'
            "</asset>"),
            "too many pixels",
        ),
        (
            world(before='<asset><hfield nrow="9999" ncol="9999" size="1 1 1 1"/></asset>'),
            "too many heights",
        ),
        (world(before='<asset><mesh file="m.stl"/></asset>'), "in a model that has a folder"),
        (world(before='<compiler meshdir="/etc"/>'), 'meshdir = "/etc": leads out'),
        (world(before='<compiler assetdir="a/../.."/>'), "leads out of the model's folder"),
    ],
)  # fmt: skip
def test_hostile_text_is_refused_by_name(text: str, message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        Mjcf(text)


def png(width: int, height: int, data: bytes, more: bytes = b"") -> bytes:
    def chunk(kind: bytes, part: bytes) -> bytes:
        return (
            struct.pack(">I", len(part)) + kind + part + struct.pack(">I", zlib.crc32(kind + part))
        )

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    texts = b"".join(chunk(b"zTXt", more) for _ in range(9)) if more else b""
    body = chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + head + texts + body


TRIANGLE = struct.pack("<12f", *[0.0] * 3, *range(9)) + b"\0\0"
CONTENTS = {
    "lies.stl": b"\0" * 80 + struct.pack("<I", 2**32 - 1) + TRIANGLE,
    "nan.stl": b"\0" * 80
    + struct.pack("<I", 1)
    + struct.pack("<12f", *[float("nan")] * 12)
    + b"..",
    "faces.stl": b"\0" * 80 + struct.pack("<I", 100_001) + TRIANGLE * 100_001,
    "nan.obj": b"v 0 0 0\nv nan 0 0\nf 1 1 1\n",
    "space.obj": b"v 0 0 0\r  v 0 1e+99 0\nf 1 1 1\n",
    "polygon.obj": b"v 0 0 0\nf" + b" 1" * 100_000,
    "polygons.obj": b"v 0 0 0\n" + (b"f" + b" 1" * 400 + b"\n") * 300,
    "lines.obj": b"vn 0 0 1\n" * 600_000,
    "lies.msh": struct.pack("<4i", 2**31 - 1, 0, 0, 4),
    "index.msh": struct.pack("<4i", 1, 0, 0, 1) + struct.pack("<3f3i", 0, 0, 0, 0, 0, 7),
    "bomb.png": png(4, 4, b"\0" * 10_000_000),
    "wide.png": png(60_000, 60_000, b""),
    "texts.png": png(1, 1, b"\0" * 4, zlib.compress(b"\0" * 1000)),
    "m.usd": b"",
    "passwd": b"root",
}


@pytest.mark.parametrize("name", CONTENTS)
def test_files_that_mujoco_would_choke_on_are_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(CONTENTS[name])
    kind = "texture" if name.endswith(".png") else "mesh"
    (tmp_path / "arm.xml").write_text(
        world(before=f'<asset>\n<{kind} name="a" file="{name}"/></asset>')
    )
    with pytest.raises(ScenarioError, match=rf'arm.xml:2: <{kind}> file = "{re.escape(name)}": '):
        Mjcf.read(tmp_path / "arm.xml")


def test_good_files_are_let_in(tmp_path: Path) -> None:
    solid = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1.000000e+00\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "a.obj").write_text(solid)
    (tmp_path / "solid.xml").write_text(
        world('<geom type="mesh" mesh="a"/>', '<asset><mesh file="a.obj"/></asset>')
    )
    assert compiled(Mjcf.read(tmp_path / "solid.xml")).nmesh == 1
    (tmp_path / "a.stl").write_bytes(b"\0" * 80 + struct.pack("<I", 1) + TRIANGLE)
    (tmp_path / "a.png").write_bytes(png(4, 4, b"\0" * 52))
    asset = '<asset><mesh name="a" file="a.stl"/><texture type="2d" name="a" file="a.png"/></asset>'
    (tmp_path / "arm.xml").write_text(world(before=asset))
    assert Mjcf.read(tmp_path / "arm.xml").folder == str(tmp_path)


def test_a_chain_of_includes_nested_too_deeply_is_refused(tmp_path: Path) -> None:
    for k in range(50):
        inside = f'<include file="{k + 1}.xml"/>'
        nest = "<body>" * 100 + inside + "</body>" * 100
        (tmp_path / f"{k}.xml").write_text(f"<mujoco>{nest}</mujoco>")
    with pytest.raises(ScenarioError, match="nested too deeply"):
        Mjcf.read(tmp_path / "0.xml")


def test_mujoco_is_given_models_in_one_place_only() -> None:
    """Every other place would be a way around the gate; the benchmark's text has passed it."""
    loaders = re.compile(
        r"from_xml_(string|path)|from_(string|file|zip)\(|from_binary_path|mj_loadXML|mj_parse|"
        r"load_model_from|MjSpec\(|mj_loadModel|add_plugin|loadPlugin"
    )
    found = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*.py")
        if loaders.search(path.read_text(encoding="utf-8"))
    }
    assert found == {"plant.py", "bench/environments.py"}
