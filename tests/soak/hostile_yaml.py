"""Scenario files and `--set` values that mean harm, made from a seed."""

from __future__ import annotations

import random
import string
from collections.abc import Iterator

GOOD = """\
name: mine
duration: 0.01
reference: {kind: sinusoid}
controller: {kind: pd}
"""

TAGS = (
    "!!python/object:os.system",
    "!!python/object/apply:os.system [touch ran]",
    "!!python/object/new:subprocess.Popen [[touch, ran]]",
    "!!python/name:os.system",
    "!!python/module:os",
    "!!python/tuple [1, 2]",
    "!!binary aGVsbG8=",
    "!!set {a, b}",
    "!!omap [a: 1]",
    "!!pairs [a: 1]",
    "!!timestamp 2001-12-14",
    "!include ../../secret.yaml",
    "!env HOME",
    "!<tag:evil.example,2026:x> 1",
    "!<!local> 1",
    "!x 1",
)
NUMBERS = (
    "1e999",
    "-1e999",
    ".inf",
    "-.INF",
    ".nan",
    "1" + "0" * 100_000,
    "9" * 200_000,
    "0x" + "f" * 100_000,
    "0." + "0" * 100_000 + "1",
    "1e" + "9" * 100,
    "-1",
    "1e400",
    "0b101",
    "1_000",
    "1:30:00",
)
KEYS = ("duration", "dt", "plant.gravity", "initial.q", "controller.kp")
CHARACTERS = ("\0", "\x07", "\x1b[31m", "\x7f", "\x85", "\u202e", "\ufeff", "\ud800", "\ufffe")


def files(rng: random.Random, count: int) -> Iterator[tuple[str, bytes]]:
    """Names and contents of scenario files, `count` of each family that varies."""
    for tag in TAGS:
        yield f"tag {tag}", _with(f"description: {tag}\n")
        yield f"tag on a key {tag[:20]}", _with(f"{tag.split()[0]} seed: 1\n")
    for number in NUMBERS:
        yield f"number {number[:20]}", _with(f"seed: {number}\n", "duration: 0.01\n")
        yield f"number {number[:20]} in a list", _with(f"initial: {{q: [{number}, x]}}\n")
    yield from _encodings()
    yield from _bombs(rng, count)
    yield from _broken(rng, count)
    yield from _names(rng, count)


def sets(rng: random.Random, count: int) -> Iterator[tuple[str, str]]:
    """Names and texts of `--set` values."""
    for tag in TAGS:
        yield f"set tag {tag}", f"description={tag}"
    for number in NUMBERS:
        for key in rng.sample(KEYS, 2):
            if number != "-1" or key != "initial.q":
                yield f"set {key} {number[:20]}", f"{key}=[{number}, x]"
    for _ in range(count):
        depth = rng.randrange(40, 5000)
        yield f"set nested {depth}", f"description={'[' * depth}{']' * depth}"
        yield f"set keys {depth}", f"{'.'.join('a' * depth)}=1"
        character = rng.choice(CHARACTERS[:5])
        yield f"set character {character!r}", f"name=a{character}b"
    yield "set bomb", f"description={_aliases(9, 10, flow=True)}"
    yield "set documents", "seed=1\n--- 2"
    yield "set nothing", "=1"
    yield "set no value", "seed="
    yield "set long", "seed=" + "x" * 100_000
    yield "set dots", "...=1"
    yield "set out", "out=/etc/passwd"


def _with(more: str, instead: str = "") -> bytes:
    text = GOOD.replace(instead, "") if instead else GOOD
    return (text + more).encode("utf-8", "surrogatepass")


def _encodings() -> Iterator[tuple[str, bytes]]:
    for name in ("utf-16", "utf-16-be", "utf-32", "utf-7", "cp037"):
        yield f"encoding {name}", (GOOD + "# ü\n").encode(name) + b"\xff"
    yield "latin-1", _with("") + "description: für\n".encode("latin-1")
    yield "cut in a character", _with("description: ") + "ü".encode()[:1]
    yield "overlong slash", _with("description: ") + b"\xc0\xaf\n"
    yield "two marks", b"\xef\xbb\xbf\xef\xbb\xbf" + GOOD.encode() + b"\xef\xbb\xbfa: 1\n"
    for character in CHARACTERS[:3]:
        yield f"character {character!r}", _with(f"description: a{character}b\n")
        yield f"character {character!r} in a key", _with(f"a{character}b: 1\n")
        yield f"character {character!r} escaped", _with(f'a: "{character!r}"\n')
    for escape in ("\\0", "\\U00110000", "\\UFFFFFFFF", "\\uD800", "\\x1b"):
        yield f"escape {escape}", _with(f'name: "a{escape}b"\n', "name: mine\n")


def _bombs(rng: random.Random, count: int) -> Iterator[tuple[str, bytes]]:
    for _ in range(count):
        width, depth = rng.randrange(4, 12), rng.randrange(8, 30)
        yield f"aliases {width}^{depth}", _with(_aliases(width, depth))
        levels = rng.randrange(40, 100_000)
        opening = rng.choice(("[", "{a: ", "- ", "? "))
        yield f"nested {levels} {opening}", _with(f"description: {opening * levels}\n")
        steps = rng.randrange(40, 600)
        stairs = "".join(f"{' ' * k}a:\n" for k in range(steps))
        yield f"stairs {steps}", _with(stairs)
        length = rng.randrange(100_000, 240_000)
        yield f"key of {length}", _with("k" * length + ": 1\n")
        yield f"unknown word of {length}", _with("seed: " + "w" * length + "\n")
        yield f"keys {length}", _with("".join(f"k{k}: 1\n" for k in range(length // 10)))
        yield f"list of {length}", _with(f"initial: {{q: [{'1,' * (length // 2)}x]}}\n")
        yield f"documents {length}", _with("--- 1\n" * (length // 6))
        yield f"anchors {length}", _with("".join(f"a{k}: &a{k} 1\n" for k in range(length // 14)))
        yield f"tag of {length}", _with("seed: !" + "t" * length + " 1\n")
        yield f"anchor of {length}", _with("seed: &" + "t" * length + " x\n")
        yield f"indent of {length}", _with("description:\n" + " " * length + "a: [\n")
    yield "10 MB", _with("# " + "x" * 10_000_000 + "\n")
    yield "10 MB of lists", _with("a: " + "[" * 10_000_000)
    yield "no end of a quote", _with('description: "' + "x" * 200_000)
    yield "recursion", _with("description: &a [*a]\n")
    yield "recursion by keys", _with("plant: &a {model: two_link, plant: *a}\n")
    yield "merge key", _with("plant: &p {gravity: 9}\ninitial: {<<: *p}\n")
    yield "merge of itself", _with("plant: &p {<<: *p}\n")
    yield "merge list", _with("plant: {<<: [{gravity: 1}, {gravity: 2}]}\n")


def _aliases(width: int, depth: int, flow: bool = False) -> str:
    lines = ["l0: &l0 [x, x]"]
    lines += [f"l{k}: &l{k} [{','.join([f'*l{k - 1}'] * width)}]" for k in range(1, depth)]
    return "{" + ", ".join(lines) + "}" if flow else "\n".join(lines) + "\n"


def _broken(rng: random.Random, count: int) -> Iterator[tuple[str, bytes]]:
    for key in ("name", "duration", "controller", "reference"):
        yield f"twice {key}", _with(f"{key}: 1\n")
    for directive in ("%YAML 1.1", "%YAML 9.9", "%TAG ! tag:evil.example,2026:", "%FOO bar"):
        more = "a: !x 1\n" if "TAG" in directive else "a: 1\n"
        yield directive, f"{directive}\n---\n{GOOD}{more}".encode()
    for text in ("", "~", "[1, 2]", "text", "a\n- b", "? [a]\n: 1", "? {a: 1}\n: 2", "\t", "*a: 1"):
        yield f"a file of {text!r}", text.encode()
    for key in ("out", "log", "python", "__class__", "__proto__", "model", "file", "from", "eval"):
        yield f"key {key}", _with(f"{key}: ../../secret\n")
    for _ in range(count):
        raw = bytearray(_with("plant: {gravity: 9.81}\nseed: 4\n"))
        for _ in range(rng.randrange(1, 4)):
            raw[rng.randrange(len(raw))] = rng.choice(b"\x00\x01\x1b\x7f\xff\xc0")
        yield f"spoilt {bytes(raw)!r}", bytes(raw)
        junk = "".join(rng.choices("[]{}&*!|>%@`,:?- \n", k=rng.randrange(3, 200)))
        yield f"junk {junk!r}", f"a: [{junk}\n[".encode()


def _names(rng: random.Random, count: int) -> Iterator[tuple[str, bytes]]:
    """Names that would place a log outside its folder."""
    made = ["../x", "/etc/x", "..", ".", ".hidden", "a/b", "a\\\\b", "", "a\\nb", "a\\0b", "a" * 65]
    made += [
        "~",
        "~root",
        "-rf",
        "a b",
        "a;b",
        "$HOME",
        "`id`",
        "a\\u202eb",
        "\\u0661",
        "a/../../b",
    ]
    made += ["../" * rng.randrange(1, 20) + rng.choice(string.ascii_letters) for _ in range(count)]
    for name in made:
        yield f"name {name}", _with(f'name: "{name}"\n', "name: mine\n")
