"""Arrays out of NumPy's npz: plain ones, stored as they are, and not one byte more than is there.

NumPy's own reader believes what the file says of sizes: a deflated member may grow a
thousandfold, and a header may ask for an array of any shape before there is data for it.
"""

from __future__ import annotations

import io
import math
import zipfile
from typing import Any

import numpy as np

Array = np.ndarray

END = 22  # bytes of a zip's last record where it has no comment
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def read_npz(data: bytes) -> dict[str, Array]:
    """Arrays by name, without pickle.

    Raises:
        ValueError: the bytes are no such file.
    """
    try:
        _check_directory(data)
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            if sum(member.file_size for member in members) > len(data):
                raise ValueError("members larger than the file")
            return {m.filename.removesuffix(".npy"): _array(archive, m) for m in members}
    except Exception as error:  # of many kinds: whatever damaged bytes provoke
        raise ValueError("no npz file of plain arrays") from error


def _check_directory(data: bytes) -> None:
    """Refuse a directory that is most of the file: the library makes an object of each entry."""
    end = data[-END:]
    if end[:4] != b"PK\5\6" or int.from_bytes(end[12:16], "little") > len(data) // 2:
        raise ValueError("a comment, or more directory than data")


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> Array:
    if member.compress_type != zipfile.ZIP_STORED or not member.filename.endswith(".npy"):
        raise ValueError("no stored array")
    content = archive.read(member)
    stream = io.BytesIO(content)
    shape, by_columns, dtype = _header(stream)
    rest = len(content) - stream.tell()
    size = math.prod(shape)
    if dtype.hasobject or size > len(content) or size * dtype.itemsize != rest:
        raise ValueError("Python objects, or other data than its header says")
    array = np.frombuffer(content, dtype, size, stream.tell())
    return array.reshape(shape, order="F" if by_columns else "C").copy()


def _header(stream: io.BytesIO) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    read = _HEADERS[np.lib.format.read_magic(stream)]
    shape, by_columns, dtype = read(stream)
    if any(side < 0 for side in shape):
        raise ValueError("a side below zero")
    return shape, by_columns, dtype
