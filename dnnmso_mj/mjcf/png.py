"""How many pixels a PNG holds, believed only if as many can be unpacked from it, and no more."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

from dnnmso_mj.mjcf.rules import MAX_PIXELS

MAX_EXTRAS = 4  # packed texts and colour profiles, each of which may unpack to megabytes
SAMPLES = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # in a pixel, by colour type
PACKED = (b"zTXt", b"iTXt", b"iCCP")


def pixels(data: bytes) -> int | None:
    """Width times height; None where the file is broken or unpacks to more than that."""
    if data[:8] != b"\x89PNG\r\n\x1a\n" or data[12:16] != b"IHDR" or len(data) < 33:
        return None
    width, height, bits, colour = struct.unpack_from(">IIBB", data, 16)
    if not 0 < width * height <= MAX_PIXELS:
        return width * height or None
    chunks = list(_chunks(data))
    if sum(kind in PACKED for kind, _ in chunks) > MAX_EXTRAS or colour not in SAMPLES:
        return None
    row = (width * SAMPLES[colour] * bits + 7) // 8 + 1
    most = row * height + 16 * (width + height) + 1024  # interlaced ones have more rows
    packed = b"".join(part for kind, part in chunks if kind == b"IDAT")
    inflate = zlib.decompressobj()
    try:
        found = inflate.decompress(packed, most + 1)
    except zlib.error:
        return None
    return width * height if len(found) <= most else None


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    start = 8
    while start + 8 <= len(data):
        size = struct.unpack_from(">I", data, start)[0]
        yield data[start + 4 : start + 8], data[start + 8 : start + 8 + size]
        start += 12 + size
