"""Models that mean harm, made from a seed; a model may bring further files."""

from __future__ import annotations

import random
import struct
import zlib
from collections.abc import Iterator

Files = dict[str, bytes]  # beside the model, which is "arm.xml"

ELEMENTS = ("geom", "body", "joint", "site", "camera", "light", "mesh", "key", "motor", "option")
PLUGINS = (
    '<extension><plugin plugin="mujoco.elasticity.cable"/></extension>',
    '<extension><plugin plugin="../../evil.so"><instance name="i"/></plugin></extension>',
)
OUTSIDE = ("../outside/{}", "{home}/outside/{}", "a/../../outside/{}", "./../outside/./{}")
NOT_PATHS = ("..\\outside\\{}", "C:{}", "file:///{home}/outside/{}", "http://127.0.0.1:9/{}")
TRIANGLE = struct.pack("<12f", *[0.0] * 3, *range(9)) + b"\0\0"
STL = b"\0" * 80 + struct.pack("<I", 1) + TRIANGLE


def world(inside: str = "", before: str = "") -> str:
    """An MJCF."""
    return f'<mujoco model="m">\n{before}\n<worldbody>\n{inside}\n</worldbody>\n</mujoco>'


def models(rng: random.Random, count: int, home: str) -> Iterator[tuple[str, Files]]:
    """Names and files; `home` is the folder that "outside", the canaries', is in."""
    for name, text in [*_xml(rng, count), *_content(rng, count), *_numbers(rng, count)]:
        yield name, {"arm.xml": text if isinstance(text, bytes) else text.encode()}
    yield from _paths(rng, home)
    yield from _includes(rng, count)
    yield from _assets(rng, count)


def _xml(rng: random.Random, count: int) -> Iterator[tuple[str, str | bytes]]:
    bomb = '<!ENTITY a0 "lol">' + "".join(
        f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 12)
    )
    yield "entity bomb", f'<!DOCTYPE m [{bomb}]><mujoco model="&a11;"/>'
    yield (
        "big entity",
        f'<!DOCTYPE m [<!ENTITY a "{"x" * 99_999}">]><mujoco model="{"&a;" * 9999}"/>',
    )
    for kind in ("SYSTEM", 'PUBLIC "x"'):
        for form in (
            "<!ENTITY a {} '../outside/secret.xml'>",
            "<!ENTITY % a {} 'file:///etc/passwd'>",
        ):
            yield (
                f"entity {kind} {form[:12]}",
                (f"<!DOCTYPE m [{form.format(kind)}]>{world('&a;')}"),
            )
    yield "outer DTD", f'<!DOCTYPE m SYSTEM "../outside/secret.xml">{world()}'
    yield (
        "xinclude",
        world('<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="/etc/x"/>'),
    )
    for encoding in ("utf-16", "utf-7", "iso-8859-1", "cp037", "x", "UCS-4"):
        yield f"says {encoding}", f'<?xml version="1.0" encoding="{encoding}"?>{world()}'
    for encoding in ("utf-16", "utf-16-be", "utf-32", "cp037"):
        yield f"is {encoding}", world().encode(encoding) + b"\xff"
    yield "latin-1", b"<mujoco model='\xfc'/>"
    yield "overlong", b"<mujoco model='\xc0\xaf'/>"
    yield "NUL", world("\0")
    yield "NUL by reference", world('<site name="a&#0;b"/>')
    yield "surrogate by reference", world('<site name="a&#xD800;b"/>')
    yield "bidi", world('<site name="a&#x202E;b"/>')
    yield "escape", world('<site name="a\x9b31m"/>')
    for text in ("", " ", "mujoco", "<", "<mujoco", "<mujoco>", "</mujoco>", "<mujoco/><mujoco/>"):
        yield f"a file of {text!r}", text
    for root in ("robot name='a'", "sdf", "mujocoinclude", "html", "a:mujoco", "MUJOCO"):
        yield f"root {root}", f"<{root}></{root.split()[0]}>"
    yield "twice an attribute", world('<site name="a" name="b"/>')
    for _ in range(count):
        depth = rng.randrange(210, 20_000)
        tag = rng.choice(("body", "frame", "default", "replicate"))
        yield f"nested {tag} {depth}", world(f"<{tag}>" * depth + f"</{tag}>" * depth)
        length = rng.randrange(2000, 1_000_000)
        place = rng.choice(('<site name="{}"/>', '<geom size="{}"/>', "<{}/>", '<site {}="1"/>'))
        yield f"long {length} {place}", world(place.format("9a"[place.count("<{}") :][0] * length))
        yield (
            f"attributes {length}",
            world("<site " + " ".join(f'a{k}="1"' for k in range(length // 10)) + "/>"),
        )
        yield f"bytes {length}", world("x" * (3_000_000 + length))
        raw = bytearray(world('<geom size="0.1"/>').encode())
        raw[rng.randrange(len(raw))] = rng.choice(b"\x00\xff\x01\x1b")
        yield f"spoilt {bytes(raw)!r}", bytes(raw)


def _content(rng: random.Random, count: int) -> Iterator[tuple[str, str]]:
    for plugin in PLUGINS:
        yield f"plugin {plugin[:40]}", world(before=plugin)
    for inside in ("body", "geom", "mesh", "actuator", "sensor", "composite"):
        yield f"plugin in {inside}", world(f'<{inside}><plugin plugin="mujoco.pid"/></{inside}>')
    for tag in (
        "composite",
        "flexcomp",
        "attach",
        "skin",
        "flex",
        "plugin",
        "script",
        "lengthrange",
    ):
        yield f"element {tag}", world(f'<body><{tag} count="9 9 9" type="grid"/></body>')
    yield (
        "model asset",
        world(before='<asset><model name="m" file="../outside/secret.xml"/></asset>'),
    )
    yield "flex", world(before='<deformable><flex name="f" dim="2" body="world"/></deformable>')
    settle = '<compiler><lengthrange mode="all" inttotal="1e9" interval="1e9" timestep="1e-9"/>'
    yield "lengthrange", world(before=f"{settle}</compiler>")
    yield "sdf", world('<geom type="sdf" mesh="m"/>')
    yield "muscle", world(before='<actuator><general dyntype="muscle" joint="j"/></actuator>')
    yield (
        "content type",
        world(before='<asset><mesh content_type="model/usd" file="m.stl"/></asset>'),
    )
    for _ in range(count):
        one, two = rng.randrange(80, 5000), rng.randrange(80, 5000)
        inner = f'<replicate count="{two}"><site size="1"/></replicate>'
        yield f"replicate {one}x{two}", world(f'<replicate count="{one}">{inner}</replicate>')
        many = rng.randrange(5001, 40_000)
        tag = rng.choice(ELEMENTS)
        yield f"{many} {tag}", world(f"<{tag}/>" * many)
        yield f"replicate {many}", world(f'<replicate count="{many * 1000}"><site/></replicate>')
        bodies = rng.randrange(1001, 2400)
        yield f"{bodies} bodies", world("<body><geom size='1'/></body>" * bodies)
        three = f"<replicate count='{rng.randrange(20, 60)}'>"
        yield f"three deep {three}", world(three * 3 + "<body/>" + "</replicate>" * 3)
    for count_ in ("-1", "0", "1e9", "x", "", "2147483648", "1.5e4", "nan"):
        yield f"replicate {count_!r}", world(f'<replicate count="{count_}"><site/></replicate>')


def _numbers(rng: random.Random, count: int) -> Iterator[tuple[str, str]]:
    for step in ("nan", "inf", "0", "-1", "-0.001", "1e9", "1e-300", "", "x", "0x1p-9", "1e999"):
        yield f"timestep {step!r}", world(before=f'<option timestep="{step}"/>')
    most = ("2000000000", "9" * 40, "-2147483649")
    places = (
        '<size {}="{}"/>|njmax nconmax nuserdata nkey nuser_body nuser_geom nstack memory',
        '<option {}="{}"/>|iterations ls_iterations noslip_iterations ccd_iterations',
        "<visual><quality {}='{}'/></visual>|shadowsize offsamples numslices numstacks numquads",
        "<visual><global {}='{}'/></visual>|offwidth offheight",
        "<custom><numeric name='n' {}='{}'/></custom>|size",
        "<sensor><user {}='{}'/></sensor>|dim",
        "<sensor><jointpos joint='j' {}='{}'/></sensor>|nsample",
        "<asset><mesh name='m' builtin='supersphere' {}='{}'/></asset>|params",
        "<asset><texture builtin='flat' width='9' height='9' {}='{}'/></asset>|width nchannel",
        "<asset><hfield size='1 1 1 1' nrow='9' ncol='9' {}='{}'/></asset>|nrow ncol",
    )
    for place in places:
        form, keys = place.split("|")
        for key in keys.split():
            value = rng.choice(most)
            text = form.format(key, value).replace(f" {key}='9'", "", 1)
            yield f"{key} {value}", world(before=text)
    for size in ("9999", "16384", "100000"):
        for kind in ("2d", "cube", "skybox"):
            yield (
                f"texture {kind} {size}",
                world(
                    before=f'<asset><texture type="{kind}" builtin="flat" width="{size}" '
                    f'height="{size}"/></asset>'
                ),
            )
    yield "memory", world(before='<size memory="64G"/>')
    yield (
        "height field",
        world(before='<asset><hfield nrow="9999" ncol="999" size="1 1 1 1"/></asset>'),
    )
    bad = ("nan", "NaN", "-inf", "+Infinity", "nan(12)", "1e999", "1e11", "-99999999999", "0x1p999")
    for _ in range(3 * count):
        tag, value = rng.choice(ELEMENTS), rng.choice(bad)
        key = rng.choice(("pos", "quat", "size", "mass", "qpos", "range", "density", "user"))
        words = ["0"] * rng.randrange(4)
        words.insert(rng.randrange(len(words) + 1), value)
        separator = rng.choice((" ", "\n", "\t", "&#10;", "  "))
        yield f"{tag} {key} {value}", world(f'<{tag} {key}="{separator.join(words)}"/>')


def _paths(rng: random.Random, home: str) -> Iterator[tuple[str, Files]]:
    def put(name: str, text: str) -> tuple[str, Files]:
        return name, {"arm.xml": text.encode()}

    for form in (*OUTSIDE, *NOT_PATHS):
        stl, png, xml = (
            form.format(name, home=home) for name in ("secret.stl", "secret.png", "secret.xml")
        )
        yield put(f"mesh {form}", world(before=f'<asset><mesh name="m" file="{stl}"/></asset>'))
        yield put(f"include {form}", world(f'<include file="{xml}"/>'))
        yield put(f"texture {form}", world(before=f'<asset><texture file="{png}"/></asset>'))
        side = rng.choice(("up", "down", "left", "right", "front", "back"))
        yield put(
            f"texture {side} {form}", world(before=f'<asset><texture file{side}="{png}"/></asset>')
        )
        yield put(
            f"hfield {form}", world(before=f'<asset><hfield file="{png}" size="1 1 1 1"/></asset>')
        )
    for key in ("meshdir", "texturedir", "assetdir"):
        for folder in ("../outside", f"{home}/outside", "a/../../outside", "/", ".."):
            before = f'<compiler {key}="{folder}"/>'
            before += '<asset><mesh file="secret.stl"/><texture file="secret.png"/></asset>'
            yield put(f"{key} {folder}", world(before=before))
    for link in ("link.stl", "links/secret.stl", "pipe.stl", "folder.stl", "zero.stl", "none.stl"):
        yield put(f"link {link}", world(before=f'<asset><mesh file="{link}"/></asset>'))
    for link in ("link.xml", "links/secret.xml", "pipe.xml", "folder.xml", "loop.xml", "zero.xml"):
        yield put(f"include {link}", world(f'<include file="{link}"/>'))


def _includes(rng: random.Random, count: int) -> Iterator[tuple[str, Files]]:
    def part(inside: str) -> bytes:
        return f"<mujocoinclude>{inside}</mujocoinclude>".encode()

    top = world('<include file="0.xml"/>').encode()
    yield "include of itself", {"arm.xml": world('<include file="arm.xml"/>').encode()}
    yield (
        "include cycle",
        {
            "arm.xml": top,
            "0.xml": part('<include file="1.xml"/>'),
            "1.xml": part('<include file="0.xml"/>'),
        },
    )
    yield "include without a file", {"arm.xml": world("<include/>").encode()}
    yield "include of nothing", {"arm.xml": top, "0.xml": b""}
    yield "include with a DTD", {"arm.xml": top, "0.xml": b"<!DOCTYPE a><mujocoinclude/>"}
    yield "include of 10 MB", {"arm.xml": top, "0.xml": b" " * 10_000_000}
    for _ in range(count):
        deep = rng.randrange(30, 60)
        nest = {
            f"{k}.xml": part("<body>" * 150 + f'<include file="{k + 1}.xml"/>' + "</body>" * 150)
            for k in range(deep)
        }
        yield f"includes nested {deep}", {"arm.xml": top, **nest}
        wide = rng.randrange(101, 150)
        parts = {f"{k}.xml": part("") for k in range(wide)}
        inside = "".join(f'<include file="{name}"/>' for name in parts)
        yield f"includes {wide}", {"arm.xml": world(inside).encode(), **parts}
        twice = {f"{k}.xml": part(f'<include file="{k + 1}.xml"/>' * 2) for k in range(30)}
        yield "includes doubled", {"arm.xml": top, **twice}
        big = {f"{k}.xml": part("<!--" + "x" * 1_000_000 + "-->") for k in range(3)}
        inside = "".join(f'<include file="{name}"/>' for name in big)
        yield "includes of 3 MB", {"arm.xml": world(inside).encode(), **big}


def _assets(rng: random.Random, count: int) -> Iterator[tuple[str, Files]]:
    def put(kind: str, name: str, data: bytes) -> tuple[str, Files]:
        text = world(before=f'<asset><{kind} name="a" file="{name}"/></asset>')
        return f"{kind} {name} of {len(data)} bytes", {"arm.xml": text.encode(), name: data}

    for _ in range(count):
        faces = rng.choice((0, 2, 10**6, 2**31, 2**32 - 1))
        yield put("mesh", "lies.stl", b"\0" * 80 + struct.pack("<I", faces) + TRIANGLE)
        yield put("mesh", "cut.stl", STL[: rng.randrange(len(STL))])
        bad = rng.choice((float("nan"), float("inf"), 3e38))
        yield put("mesh", "nan.stl", STL[:100] + struct.pack("<f", bad) + STL[104:])
        sizes = [rng.choice((-1, 3, 2**30, 2**31 - 1)) for _ in range(4)]
        yield put("mesh", "lies.msh", struct.pack("<4i", *sizes))
        yield put("mesh", "faces.stl", STL[:80] + struct.pack("<I", 120_000) + TRIANGLE * 120_000)
        vertex = rng.choice((b"nan 0 0", b"0 inf 0", b"1e99 0 0", b"0 0 999999999999"))
        yield put("mesh", "odd.obj", b"v 0 0 0\nv " + vertex + b"\nf 1 1 2\n")
        yield put("mesh", "many.obj", b"v 0 0 0\n" + b"f 1 1 1\n" * rng.randrange(100_001, 200_000))
        wide, high = rng.randrange(10_000, 2**31), rng.randrange(10_000, 2**31)
        yield put("texture", "wide.png", png(wide, high, b""))
        yield put("texture", "bomb.png", png(4, 4, b"\0" * rng.randrange(10**6, 4 * 10**7)))
        yield put("texture", "texts.png", png(4, 4, b"\0" * 52, texts=rng.randrange(5, 99)))
        rows = rng.choice((-1, 0, 2**31 - 1, 46_341))
        yield put("hfield", "lies.bin", struct.pack("<2i", rows, rows) + b"\0" * 64)
    yield put("mesh", "big.obj", b"#" * (33 * 1024 * 1024))
    for name in ("secret.so", "a.usd", "a.mjb", "a.py", "a", "a.xml"):
        yield put("mesh", name, b"x")
    yield put("texture", "a.ktx", b"x")


def png(width: int, height: int, data: bytes, texts: int = 0) -> bytes:
    """A picture in RGB whose header may not be true of its data."""

    def chunk(kind: bytes, part: bytes) -> bytes:
        return (
            struct.pack(">I", len(part)) + kind + part + struct.pack(">I", zlib.crc32(kind + part))
        )

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    packed = chunk(b"zTXt", b"a\0\0" + zlib.compress(b"\0" * 1_000_000))
    return (
        b"\x89PNG\r\n\x1a\n" + head + packed * texts + chunk(b"IDAT", zlib.compress(data))
        + chunk(b"IEND", b"")
    )  # fmt: skip
