"""A good log, damaged in every region of it and in many ways; the same seed, the same damage."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

RECORD = struct.Struct("<BQ")
MAGIC = 8
CHUNK, INDEX, ATTACHMENT, METADATA, DATA_END, FOOTER = 6, 7, 9, 12, 15, 2
CHUNK_HEADER = 9 + 8 + 8 + 8 + 4 + 4 + 3 + 8  # to its compressed data: kind … lz4 … length
NAMES = {
    1: "header", CHUNK: "chunk", INDEX: "message index", ATTACHMENT: "attachment",
    METADATA: "metadata", DATA_END: "data end", FOOTER: "footer",
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A damaged file.

    Args:
        name: enough to make it again from the same log.
        data: its bytes.
    """

    name: str
    data: bytes


def records(data: bytes) -> list[tuple[int, int, int]]:
    """Kind, beginning and end of every record of a good log."""
    found, at = [], MAGIC
    while at < len(data) - MAGIC:
        kind, length = RECORD.unpack_from(data, at)
        found.append((kind, at, at + RECORD.size + length))
        at = found[-1][2]
    return found


def regions(data: bytes) -> dict[str, list[tuple[int, int]]]:
    """Where each region of a good log is; one of several stretches."""
    found: dict[str, list[tuple[int, int]]] = {"magic": [(0, MAGIC)]}
    summary = False
    for kind, start, end in records(data):
        summary = summary or kind == DATA_END
        if kind == CHUNK:
            found.setdefault("chunk header", []).append((start, start + CHUNK_HEADER))
            found.setdefault("compressed data", []).append((start + CHUNK_HEADER, end))
        else:
            name = NAMES.get(kind, "summary") if not summary or kind in NAMES else "summary"
            found.setdefault(name, []).append((start, end))
    found["end magic"] = [(len(data) - MAGIC, len(data))]
    return found


def truncations(data: bytes, count: int, rng: np.random.Generator) -> Iterator[Case]:
    """Cut at so many offsets, ends of records and their neighbours among them."""
    edges = {at + k for _, _, at in records(data) for k in (-1, 0, 1)}
    some = rng.permutation(sorted(edges & set(range(len(data)))))[: count // 4].tolist()
    anywhere = rng.integers(0, len(data), count - len(some)).tolist()
    for at in [*some, *anywhere]:
        yield Case(f"cut at {at}", data[:at])


def flips(data: bytes, each: int, rng: np.random.Generator) -> Iterator[Case]:
    """One bit, as often in each region; then several bits at once, anywhere."""
    for name, parts in regions(data).items():
        for _ in range(each):
            start, end = parts[int(rng.integers(len(parts)))]
            yield flipped(data, [int(rng.integers(8 * start, 8 * end))], name)
    for _ in range(2 * each):
        count = int(rng.integers(2, 40))
        yield flipped(data, rng.integers(0, 8 * len(data), count).tolist(), "anywhere")


def flipped(data: bytes, bits: list[int], where: str) -> Case:
    """These bits flipped; one that is named twice stays."""
    out = bytearray(data)
    for bit in bits:
        out[bit // 8] ^= 1 << bit % 8
    return Case(f"bits {bits} flipped, {where}", bytes(out))


def frames(data: bytes, count: int, rng: np.random.Generator) -> Iterator[Case]:
    """Kind and length of records in the middle, bit by bit: a record that passes for another."""
    places = [(kind, at) for kind, at, _ in records(data) if kind in NAMES]
    bits = [8 * at + bit for _, at in places for bit in range(8 * RECORD.size)]
    kinds = [8 * at + bit for kind, at in places if kind == CHUNK for bit in range(8)]
    chosen = [*rng.permutation(kinds)[: count // 2], *rng.permutation(bits)[: count - count // 2]]
    for bit in chosen:
        yield flipped(data, [int(bit)], "kind or length of a record")


def blocks(data: bytes, count: int, rng: np.random.Generator) -> Iterator[Case]:
    """Bytes put in, taken out, zeroed (as after a power cut), or overwritten."""
    for k in range(count):
        at, size = int(rng.integers(len(data))), int(rng.choice([1, 4, 16, 512, 4096, 20_000]))
        rest, junk = data[at + size :], rng.bytes(size)
        made = {
            "put in": data[:at] + junk + data[at:],
            "taken out": data[:at] + rest,
            "zeroed": data[:at] + bytes(min(size, len(data) - at)) + rest,
            "zeroed to the end": data[:at] + bytes(len(data) - at),
            "overwritten": data[:at] + junk[: len(data) - at] + rest,
            "behind the end": data + junk,
        }
        name = list(made)[k % len(made)]
        yield Case(f"{size} bytes at {at} {name} (block {k})", made[name])


def splices(data: bytes, count: int, rng: np.random.Generator) -> Iterator[Case]:
    """Whole records taken out, doubled, swapped or swallowed: all that is left is well formed."""
    chunks = _chunks(data)
    for k in range(count):
        first, second = sorted(rng.choice(len(chunks), 2, replace=False).tolist())
        (a, b), (c, d) = chunks[first], chunks[second]
        swallowed = bytearray(data)
        RECORD.pack_into(swallowed, a, CHUNK, d - a - RECORD.size)
        made = {
            "taken out": data[:a] + data[b:],
            "doubled": data[:b] + data[a:b] + data[b:],
            "swapped": data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:],
            "up to the other swallowed": bytes(swallowed),
            "taken out up to the other": data[:a] + data[d:],
        }
        name = list(made)[k % len(made)]
        yield Case(f"chunks {first}, {second}: {name}", made[name])


def _chunks(data: bytes) -> list[tuple[int, int]]:
    """Each chunk with the indexes that belong to it."""
    found: list[tuple[int, int]] = []
    for kind, start, end in records(data):
        if kind == CHUNK:
            found.append((start, end))
        elif kind == INDEX and found:
            found[-1] = (found[-1][0], end)
    return found
