"""The name of a log to be: one run has it at a time, and what is there is whole before and after.

A log begins in a hidden file, which takes the name once it says what it is. So a name holds the
old log or the new one, never nothing, an empty file or a mixture. The file is locked while it is
written, and the lock goes with the process.
"""

from __future__ import annotations

import fcntl
import os
import time
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from mcap.writer import MCAP0_MAGIC

from dnnmso_mj.errors import LogError
from dnnmso_mj.files import name_new, open_beside

PATIENCE = 0.1  # s; whoever only looks at a file has it for less


class Place:
    """A log's file and name: write its beginning to `file`, then `take` the name.

    Args:
        path: the name.
        force: whether the log that is there may be replaced; what is no log never is.

    Raises:
        LogError: something is there that may not be replaced, or is being written.
        OSError: the folder cannot be written.
    """

    def __init__(self, path: Path, force: bool = False) -> None:
        self.path = path
        self._force = force
        self._refuse()
        self.file: BinaryIO
        self.file, self._part = open_beside(path)
        _lock(self.file.fileno())

    def take(self) -> None:
        """Give the file its name; an older log is gone then.

        Raises:
            LogError: somebody else was first.
            OSError: the folder cannot be written.
        """
        try:
            while not self._taken():
                pass
        except BaseException:
            self.give_up()
            raise

    def give_up(self) -> None:
        """Leave everything as it was, unless the name has been taken."""
        with suppress(OSError):
            self.file.close()
        with suppress(OSError):
            self._part.unlink(missing_ok=True)

    @property
    def is_there(self) -> bool:
        """Whether the name still is that of this file."""
        with suppress(OSError):
            return os.path.samestat(self.path.lstat(), os.fstat(self.file.fileno()))
        return False

    def _refuse(self) -> None:
        if os.path.lexists(self.path):
            old = self._open_old()
            if old is not None:
                os.close(old)

    def _taken(self) -> bool:
        """Try once; False: another file has come or gone meanwhile."""
        old = self._open_old() if os.path.lexists(self.path) else None
        if old is None:
            try:
                name_new(self._part, self.path)
            except FileExistsError:
                return False
            return True
        try:
            # It is locked: nobody else can be about to replace the same one.
            with suppress(FileNotFoundError):
                if os.path.samestat(self.path.lstat(), os.fstat(old)):
                    self._part.replace(self.path)
                    return True
        finally:
            os.close(old)
        return False

    def _open_old(self) -> int | None:
        """Open and lock the log that is to be replaced; None: it has gone.

        Raises:
            LogError: it may not be replaced.
        """
        if self.path.is_symlink() or not self.path.is_file():  # a FIFO would wait for a writer
            if not os.path.lexists(self.path):
                return None
            raise self._exists() if not self._force else self._no_log()
        try:
            old = os.open(self.path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise (self._no_log() if self._force else self._exists()) from error
        try:
            if not _lock(old, PATIENCE if self._force else 0.0):
                raise LogError(
                    f"{self.path}: another run is writing it now. "
                    "Choose another name, or wait for it."
                )
            if not self._force:
                raise self._exists()
            if os.read(old, len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                raise self._no_log()
        except BaseException:
            os.close(old)
            raise
        return old

    def _exists(self) -> LogError:
        return LogError(
            f"{self.path} exists already. Choose another name, or replace it with --force."
        )

    def _no_log(self) -> LogError:
        return LogError(
            f"{self.path} is no log (an MCAP file), and --force replaces nothing else. "
            "Choose another name."
        )


def _lock(file: int, patience: float = 0.0) -> bool:
    """Lock a file until it is closed; False: somebody else still has it after so many seconds."""
    end = time.monotonic() + patience
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= end:
                return False
            time.sleep(patience / 10)
        except OSError:  # a file system without locks: then names alone keep runs apart
            return True
        else:
            return True
