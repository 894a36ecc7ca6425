"""Something tried in a process of its own, which is watched: its time, its memory, what it opens.

Files outside are canaries: the kernel tells (inotify) of every open, read and write of them, by
whatever code. Opening a canary that is a FIFO would never end.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import select
import signal
import struct
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path

from dnnmso_mj.errors import DnnmsoError

LIBC = ctypes.CDLL(None, use_errno=True)
ACCESS, MODIFY, ATTRIB, OPEN, CREATE, DELETE, MOVED = 0x1, 0x2, 0x4, 0x20, 0x100, 0x200, 0xC0
EVENT = struct.Struct("iIII")
MOST_CPU = 10  # s, of a fork, which is then ended


@dataclass
class Outcome:
    """How something ended.

    Args:
        error: the name of what was raised; "" for nothing, "hang" and "died" for the process.
        ours: whether that is one of the errors for people.
        text: its message.
        seconds: of the processor; wall time of a hang.
        grown: bytes by which its memory grew at its peak.
        touched: canaries that were opened, read or written meanwhile.
    """

    error: str = ""
    ours: bool = False
    text: str = ""
    seconds: float = 0.0
    grown: int = 0
    touched: list[str] = field(default_factory=list)


class Canaries:
    """A folder of files that nobody may open."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._fd = LIBC.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
        assert self._fd >= 0, os.strerror(ctypes.get_errno())
        self._seen = tree_hash(folder)
        mask = ACCESS | MODIFY | ATTRIB | OPEN | CREATE | DELETE | MOVED
        added = LIBC.inotify_add_watch(self._fd, os.fsencode(folder), mask)
        assert added >= 0, os.strerror(ctypes.get_errno())

    def touched(self) -> list[str]:
        """Names that were touched since last asked."""
        names = []
        while select.select([self._fd], [], [], 0)[0]:
            data, start = os.read(self._fd, 1 << 16), 0
            while start < len(data):
                _, mask, _, length = EVENT.unpack_from(data, start)
                name = data[start + EVENT.size : start + EVENT.size + length].rstrip(b"\0")
                names.append(f"{os.fsdecode(name) or '.'} ({mask:#x})")
                start += EVENT.size + length
        return names

    def unchanged(self) -> bool:
        """Whether every file is as it was; asks for the files themselves, and so comes last."""
        return tree_hash(self.folder) == self._seen

    def close(self) -> None:
        """Watch no more."""
        os.close(self._fd)


def tree_hash(folder: Path) -> str:
    """Of the names, kinds and contents of everything in a folder."""
    whole = sha256()
    for path in sorted(folder.rglob("*")):
        whole.update(f"{path.relative_to(folder)} {path.lstat().st_mode:o}\n".encode())
        if path.is_file() and not path.is_symlink():
            whole.update(path.read_bytes())
    return whole.hexdigest()


def watch(action: Callable[[], object], canaries: Canaries, seconds: float = 60.0) -> Outcome:
    """Do something in a fork of this process, for at most so many seconds of the wall clock.

    The processor's are fewer (`MOST_CPU`): others may have it meanwhile.
    """
    canaries.touched()
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        _report(action, writing)
    os.close(writing)
    started = time.monotonic()
    data = b""
    while True:
        left = seconds - (time.monotonic() - started)
        if left <= 0 or not select.select([reading], [], [], left)[0]:
            break
        part = os.read(reading, 1 << 16)
        if not part:
            break
        data += part
    os.close(reading)
    if time.monotonic() - started >= seconds:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        outcome = Outcome(error="hang", seconds=seconds)
    else:
        _, status = os.waitpid(child, 0)
        died = Outcome(error="died", text=f"wait status {status}")
        outcome = Outcome(**json.loads(data)) if data else died
    outcome.touched = canaries.touched()
    return outcome


def _report(action: Callable[[], object], writing: int) -> None:
    """In the child: do it, say how it ended, and leave nothing behind."""
    resource.setrlimit(resource.RLIMIT_CPU, (MOST_CPU, MOST_CPU))
    silent = os.open(os.devnull, os.O_RDWR)
    for stream in (1, 2):
        os.dup2(silent, stream)
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins here
    before = _kilobytes("VmRSS")
    found = Outcome()
    started = time.process_time()
    try:
        action()
    except DnnmsoError as error:
        found = Outcome(type(error).__name__, True, str(error))
    except BaseException as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(last.filename).name}:{last.lineno}"
        found = Outcome(type(error).__name__, False, f"{error} at {place}"[:300])
    found.seconds = time.process_time() - started
    found.grown = max(0, _kilobytes("VmHWM") - before) * 1024
    try:
        view = memoryview(json.dumps(vars(found)).encode())
        while view:
            view = view[os.write(writing, view) :]
    finally:
        os._exit(0)


def _kilobytes(key: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(key)).split()[1])
