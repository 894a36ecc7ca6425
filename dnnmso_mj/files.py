"""Files that are whole or not there: written beside their place, and moved there at the end."""

from __future__ import annotations

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from hashlib import sha256
from pathlib import Path
from typing import BinaryIO

# Where a file system knows no hard links.
_NO_LINKS = {errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL, errno.EMLINK}


def write_whole(path: Path, data: bytes) -> None:
    """Write beside the place, and only then move there; the folder is made.

    Raises:
        OSError: it cannot be written; an older file is as it was.
    """
    with whole_file(path) as file:
        file.write(data)


@contextmanager
def whole_file(path: Path, *, replace: bool = True, sync: bool = False) -> Iterator[BinaryIO]:
    """A file to write, which gets its name when the block is left without an exception.

    Args:
        path: its name; the folder is made.
        replace: whether it may take the place of another file.
        sync: whether the disk has it by then.

    Raises:
        OSError: it cannot be written; an older file is as it was.
        FileExistsError: something is there and `replace` is False.
    """
    file, part = open_beside(path)
    try:
        with file:
            yield file
            file.flush()
            if sync:
                os.fsync(file.fileno())
        if replace:
            part.replace(path)
        else:
            name_new(part, path)
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def open_beside(path: Path) -> tuple[BinaryIO, Path]:
    """A new file of a name of its own, hidden in the folder where `path` is to be.

    No link that somebody has put there is followed, and no file opened that was there before.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.parent / f".dnnmso-{secrets.token_hex(6)}.part"
    try:
        # Read, too: who writes a log reads it back even where its name has been taken away.
        return part.open("x+b"), part
    except FileNotFoundError as error:
        raise FileNotFoundError(error.errno, error.strerror, str(path.parent)) from error


def name_new(part: Path, path: Path) -> None:
    """Give a file the name `path` if nothing is there; of many who try at once one succeeds.

    Raises:
        FileExistsError: something is there, if only a link to nowhere.
    """
    try:
        os.link(part, path)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL))  # ours now, if empty
        part.replace(path)
    else:
        part.unlink()


def digest(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    return sha256(path.read_bytes()).hexdigest()
