"""What makes writing fail: a small disk, files whose n-th write fails, limits of the process."""

from __future__ import annotations

import atexit
import io
import itertools
import os
import resource
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from dnnmso_mj import files
from dnnmso_mj.log import place

PAGE = 4096


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Path | None]:
    """A disk of so many bytes; None where none can be mounted here."""
    folder.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    try:
        done = subprocess.run(words, capture_output=True, check=False).returncode == 0
    except OSError:
        done = False
    try:
        yield folder if done else None
    finally:
        if done:
            subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(disk: Path, left: int) -> None:
    """Leave so many bytes, in whole pages."""
    ballast = disk / "ballast"
    ballast.unlink(missing_ok=True)
    status = os.statvfs(disk)
    size = status.f_bavail * status.f_frsize - left // PAGE * PAGE
    with ballast.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, max(PAGE, size))


def failing_writes(nth: int, code: int, tear: bool, counter: str) -> None:
    """From now on the n-th write of a file with a name to be, or of a journal, and all later, fail.

    Args:
        nth: from 1; 0: none, they are counted.
        code: an errno.
        tear: whether half of it is written before.
        counter: a file that says at the end how many there were.
    """
    real_write, real_sync, real_open = os.write, os.fsync, files.open_beside

    writes = itertools.count(1)
    done = [0]

    def due() -> bool:
        done[0] = next(writes)
        return 0 < nth <= done[0]

    def write(file: int, data: bytes) -> int:
        if due():
            if tear and done[0] == nth:
                return real_write(file, data[: len(data) // 2])
            raise OSError(code, os.strerror(code))
        return real_write(file, data)

    class Raw(io.FileIO):
        def write(self, data: Any) -> int:
            if due():
                if tear and done[0] == nth and len(data) > 1:
                    return super().write(bytes(data)[: len(data) // 2])
                raise OSError(code, os.strerror(code))
            return super().write(data)

    def sync(file: int) -> None:
        if due():
            raise OSError(code, os.strerror(code))
        real_sync(file)

    def open_beside(path: Path) -> tuple[BinaryIO, Path]:
        file, part = real_open(path)
        file.close()
        raw: Any = Raw(part, "r+")
        return io.BufferedRandom(raw), part  # type: ignore[return-value]

    def note() -> None:
        Path(counter).write_text(str(done[0]))

    for module in (files, place):
        module.open_beside = open_beside
    os.write, os.fsync = write, sync
    atexit.register(note)
    from multiprocessing import util

    util.Finalize(None, note, exitpriority=0)


def small_files(size: int) -> None:
    """No file grows beyond so many bytes."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def few_files(more: int) -> None:
    """So many more files may be open than are now."""
    now = max(int(name) for name in os.listdir("/proc/self/fd")) + 1
    resource.setrlimit(resource.RLIMIT_NOFILE, (now + more, now + more))
