"""The text of a file that comes from anywhere."""

from __future__ import annotations

from pathlib import Path

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.wording import clean

# ruamel.yaml takes time that grows with the square of a long tag: 1 s for 256 KiB, 13 s for 1 MiB.
MAX_BYTES = 256 * 1024


def read_text(file: Path) -> str:
    """The whole file, UTF-8.

    Raises:
        ScenarioError: it cannot be read, is too large, or is not UTF-8.
    """
    name = clean(str(file))
    try:
        with file.open("rb") as stream:
            raw = stream.read(MAX_BYTES + 1)
    except OSError as error:
        raise ScenarioError(f"{name}: cannot be read: {error.strerror}") from error
    if len(raw) > MAX_BYTES:
        raise ScenarioError(f"{name}: too large for a scenario; allowed: {MAX_BYTES} bytes")
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        byte = raw[error.start]
        raise ScenarioError(f"{name}:{line}: byte 0x{byte:02x}; allowed: text in UTF-8") from error
