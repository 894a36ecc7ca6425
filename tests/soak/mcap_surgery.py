"""MCAP files taken apart and put together again, with checksums and lengths that fit what is in."""

from __future__ import annotations

import io
import json
import random
import struct
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import lz4.frame
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

HEAD = struct.Struct("<BQ")
CHUNK = struct.Struct("<QQQI")
Record = tuple[int, bytes]
Raw = Callable[[bytes, int], bytes]  # bytes and their greatest length -> other bytes

ODD_NUMBERS = (0, 1, 2, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)
ODD_VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1, 0.5, 1e308, -1e308, float("nan"), float("inf"), 10**30, "", "a", [], {},
    [[]], {"kind": "pd"}, {"kind": "nothing"}, [1, 2], "x.py:F",
)  # fmt: skip
LONGEST = 60_000


def take_apart(data: bytes) -> list[Record]:
    """The records, as far as they are whole."""
    found, at = [], len(MCAP0_MAGIC)
    while at + HEAD.size <= len(data):
        kind, length = HEAD.unpack_from(data, at)
        at += HEAD.size
        if length > len(data) - at:
            break
        found.append((kind, data[at : at + length]))
        at += length
    return found


def put_together(records: list[Record]) -> bytes:
    """A file of records; what DATA_END and FOOTER say of the rest is made anew."""
    data, summary_at = bytearray(MCAP0_MAGIC), 0
    for kind, given in records:
        body = given
        if kind == Opcode.DATA_END and len(body) == 4:
            body = struct.pack("<I", zlib.crc32(data))
        elif kind == Opcode.FOOTER and len(body) == 20:
            start = summary_at if body[:8] != bytes(8) else 0
            head = HEAD.pack(kind, 20) + struct.pack("<Q", start) + body[8:16]
            body = head[HEAD.size :] + struct.pack("<I", zlib.crc32(data[summary_at:] + head))
        data += HEAD.pack(kind, len(body)) + body
        if kind == Opcode.DATA_END:
            summary_at = len(data)
    return bytes(data + MCAP0_MAGIC)


def operate(data: bytes, rng: random.Random, raw: Raw) -> bytes:
    """Change a file in one place or a few, somewhere inside, and heal it around them."""
    records = take_apart(data)
    if not records:
        return raw(data, LONGEST)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        _change(records, rng, raw)
    out = put_together(records)
    match rng.randrange(12):
        case 0:
            return out[: rng.randrange(len(out))]
        case 1:
            return raw(out, LONGEST)
    return out


def _change(records: list[Record], rng: random.Random, raw: Raw) -> None:
    """One change to the list, or to a record in it."""
    if not records:
        return
    place = rng.randrange(len(records))
    kind, body = records[place]
    match rng.randrange(14):
        case 0:
            records.pop(place)
        case 1:
            records.insert(rng.randrange(len(records) + 1), (kind, body))
        case 2:
            other = rng.randrange(len(records))
            records[place], records[other] = records[other], records[place]
        case 3:
            records[place] = rng.randrange(20), body
        case 4:
            records[place] = kind, _odd_number(body, rng)
        case 5:
            records[place] = kind, raw(body, LONGEST)
        case _:
            records[place] = kind, _inside(kind, body, rng, raw)


def _inside(kind: int, body: bytes, rng: random.Random, raw: Raw) -> bytes:
    """A record changed in what it holds, with lengths and checksums of its own that fit."""
    with suppress(struct.error, ValueError, KeyError, IndexError, RuntimeError, zipfile.BadZipFile):
        if kind == Opcode.CHUNK:
            return _chunk(body, rng, raw)
        if kind == Opcode.ATTACHMENT:
            return _attachment(body, rng, raw)
        if kind == Opcode.METADATA:
            return _metadata(body, rng, raw)
        if kind == Opcode.MESSAGE and len(body) > 22:
            data = body[22:]
            odd = rng.random() < 0.5
            return body[:22] + (_odd_number(data, rng) if odd else raw(data, LONGEST))
    return raw(body, LONGEST)


def _odd_number(body: bytes, rng: random.Random) -> bytes:
    """A number of 2, 4 or 8 bytes somewhere, replaced."""
    width = rng.choice((2, 4, 8))
    if len(body) < width:
        return body
    at = rng.randrange(min(len(body) - width + 1, 256))
    number = rng.choice(ODD_NUMBERS) % 2 ** (8 * width)
    return body[:at] + number.to_bytes(width, "little") + body[at + width :]


def _chunk(body: bytes, rng: random.Random, raw: Raw) -> bytes:
    start, end, size, crc = CHUNK.unpack_from(body)
    (length,) = struct.unpack_from("<I", body, CHUNK.size)
    at = CHUNK.size + 4 + length
    name, packed = body[CHUNK.size + 4 : at], body[at + 8 :]
    content = lz4.frame.decompress(packed) if name == b"lz4" else packed
    inner = take_apart(bytes(len(MCAP0_MAGIC)) + content)
    if rng.random() < 0.9:
        _change(inner, rng, raw)
        content = b"".join(HEAD.pack(kind, len(part)) + part for kind, part in inner)
    else:
        content = raw(content, LONGEST)
    name = rng.choice((b"lz4", b"lz4", b"lz4", b"", b"zstd", name))
    packed = lz4.frame.compress(content) if name == b"lz4" else content
    if rng.random() < 0.1:
        packed = raw(packed, LONGEST)
    elif rng.random() < 0.9:
        size, crc = len(content), rng.choice((zlib.crc32(content), zlib.crc32(content), 0))
    head = CHUNK.pack(start, end, size, crc) + _text(name)
    return head + struct.pack("<Q", len(packed)) + packed


def _attachment(body: bytes, rng: random.Random, raw: Raw) -> bytes:
    times, at = body[:16], 16
    name, at = _read_text(body, at)
    media, at = _read_text(body, at)
    data = body[at + 8 : -4]
    if name.startswith(b"snapshot") and rng.random() < 0.8:
        data = _archive(data, rng, raw)
    elif rng.random() < 0.7:
        data = raw(data, LONGEST)
    else:
        name = raw(name, 200)
    whole = times + _text(name) + _text(media) + struct.pack("<Q", len(data)) + data
    return whole + struct.pack("<I", zlib.crc32(whole))


def _archive(data: bytes, rng: random.Random, raw: Raw) -> bytes:
    """A snapshot's npz with another array in it, or packed in another way."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        parts = [(info.filename, archive.read(info)) for info in archive.infolist()]
    place = rng.randrange(len(parts))
    name, array = parts[place]
    match rng.randrange(5):
        case 0:
            parts[place] = name, raw(array, LONGEST)
        case 1:
            words = (b"(1000000000000,)", b"(-1,)", b"(0, 99999999999)", b"True", b"'|O'", b"'<U9'")
            parts[place] = name, array.replace(b"(", rng.choice(words), 1)
        case 2:
            parts[place] = name, array[: rng.randrange(len(array) + 1)]
        case 3:
            parts.append((rng.choice(("../x.npy", "x", "", name, "a" * 300)), array))
        case _:
            parts[place] = name, _odd_number(array, rng)
    out = io.BytesIO()
    packing = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    with zipfile.ZipFile(out, "w", packing) as archive:
        for name, array in parts:
            archive.writestr(name or "n", array)
    return out.getvalue()


def _metadata(body: bytes, rng: random.Random, raw: Raw) -> bytes:
    name, at = _read_text(body, 0)
    at += 4
    entries = []
    while at < len(body):
        key, at = _read_text(body, at)
        value, at = _read_text(body, at)
        entries.append((key, value))
    if entries:
        place = rng.randrange(len(entries))
        key, value = entries[place]
        if value[:1] in (b"{", b"[") and rng.random() < 0.8:
            entries[place] = key, _json(value, rng)
        else:
            other = rng.random() < 0.2
            entries[place] = (raw(key, 100), value) if other else (key, raw(value, 20_000))
    packed = b"".join(_text(key) + _text(value) for key, value in entries)
    return _text(name) + struct.pack("<I", len(packed)) + packed


def _json(text: bytes, rng: random.Random) -> bytes:
    """A value somewhere in some JSON replaced."""
    whole = json.loads(text)
    here: Any = whole
    while True:
        keys: list[Any] = list(here) if isinstance(here, dict) else list(range(len(here)))
        if not keys:
            return json.dumps(rng.choice(ODD_VALUES)).encode()
        key = rng.choice(keys)
        if isinstance(here[key], dict | list) and rng.random() < 0.8:
            here = here[key]
            continue
        if rng.random() < 0.2 and isinstance(here, dict):
            del here[key]
        else:
            here[key] = rng.choice(ODD_VALUES)
        return json.dumps(whole).encode()


def _text(text: bytes) -> bytes:
    return struct.pack("<I", len(text)) + text


def _read_text(body: bytes, at: int) -> tuple[bytes, int]:
    (length,) = struct.unpack_from("<I", body, at)
    end = at + 4 + length
    if end > len(body):
        raise ValueError("no text")
    return body[at + 4 : end], end
