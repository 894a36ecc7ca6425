"""Files opened to be read, which nobody can make wait for ever."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path

from mcap.writer import MCAP0_MAGIC

from dnnmso_mj.errors import LogError

HINT = "Give a log that `dnnmso run` wrote."


class NotRegularError(OSError):
    """A directory, a FIFO, a socket or a device; `strerror` says which."""


def open_regular(path: Path) -> tuple[BufferedReader, int]:
    """Open a regular file, and tell its size as it is now.

    Nothing is mapped into memory: where somebody cuts the file meanwhile, less is read, but a
    mapping would end the process.

    Returns:
        The file, to be closed, and its size in bytes.

    Raises:
        OSError: it cannot be opened.
        NotRegularError: it is something else.
    """
    _refuse_others(path.stat())  # to open a FIFO would wait for who writes it, or disturb them
    file = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    try:
        status = os.fstat(file)
        _refuse_others(status)
        return open(file, "rb"), status.st_size
    except BaseException:
        os.close(file)
        raise


@contextmanager
def open_mcap(path: Path) -> Iterator[tuple[BufferedReader, int]]:
    """A file that begins like an MCAP, behind these first bytes, and its size.

    Raises:
        LogError: it is missing, unreadable, not a regular file, empty or something else.
    """
    try:
        file, size = open_regular(path)
    except NotRegularError as error:
        raise LogError(f"{path} is {error.strerror}; allowed: an MCAP file. {HINT}") from error
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from error
    with file:
        try:
            magic = file.read(len(MCAP0_MAGIC)) if size else b""
        except OSError as error:
            raise unreadable(path, error) from error
        if magic != MCAP0_MAGIC:
            found = f"begins with {magic!r}" if magic else "is empty"
            raise LogError(f"{path} {found}; expected an MCAP file. {HINT}")
        yield file, size


def unreadable(path: Path, error: OSError | ValueError) -> LogError:
    """The error to raise when the operating system does not let a file be read."""
    return LogError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}. {HINT}")


def _refuse_others(status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        kind = "a directory" if stat.S_ISDIR(status.st_mode) else "not a regular file"
        raise NotRegularError(0, kind)
