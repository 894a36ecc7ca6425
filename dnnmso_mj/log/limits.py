"""How much a log may hold for its size: far above what runs write, and below what hurts a reader.

What is compressed can be 250 times what is in the file, and a few bytes of JSON make hundreds in
memory. A reader that keeps to these limits needs at most 64 MB and ten times the file's size.
"""

from __future__ import annotations

from pathlib import Path

from dnnmso_mj.errors import LogError

MIB = 1 << 20
CHUNK = 16 * MIB  # of one chunk's content; ours have 64 KiB
DEFINITIONS = MIB  # of all schemas and channels
METADATA = 2 * MIB  # of all metadata records
JSON_TEXT = MIB  # of a text in one; a tenth of it values
STEP = MIB  # of one message on /step
JOINTS = LAYERS = 1000


def contents(size: int) -> int:
    """Bytes in all chunks of a file of `size` bytes: what lz4 can reach."""
    return 64 * MIB + 256 * size


def runs(size: int) -> int:
    """How many stretches of messages of one kind; ours have a few in each 50 ms."""
    return 10_000 + size // 16


def rows(size: int) -> int:
    """Bytes of numbers; those of runs take up to twice what they take in the file."""
    return 24 * MIB + 7 * size


def events(size: int) -> int:
    """Bytes of events, each counted as `EVENT` bytes more than its message has."""
    return 4 * MIB + size


EVENT = 256


def odd_steps(size: int) -> int:
    """Messages on /step that another program laid out, and which are read one by one."""
    return 5_000 + size // 64


def too_much(path: Path, what: str, most: int, size: int) -> LogError:
    """The error to raise where a log exceeds a limit."""
    return LogError(
        f"{path}: more than {most} {what}, which is too much for a file of {size} bytes. "
        "Give a log that `dnnmso run` wrote."
    )
