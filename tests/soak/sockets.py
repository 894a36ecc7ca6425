"""Sockets that processes listen on, looked at from their start to their end."""

from __future__ import annotations

import ipaddress
import os
import struct
import threading
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

PERIOD_S = 0.01
MARK = "DNNMSO_SOAK_MARK"
WAITING = {"tcp": "0A", "tcp6": "0A", "udp": "07", "udp6": "07"}  # states: listening, unconnected


@dataclass(frozen=True, order=True)
class Socket:
    """One that waits for others: protocol, local address, port, and the process that owns it."""

    protocol: str
    host: str
    port: int
    program: str

    @property
    def is_local(self) -> bool:
        """Whether only this machine reaches it."""
        address = ipaddress.ip_address(self.host)
        inner = getattr(address, "ipv4_mapped", None)
        return (inner or address).is_loopback


@dataclass
class Watch:
    """What is seen of the processes that carry a mark in their environment, and of their children.

    Args:
        mark: put it into the environment of what is started.
        looks: how often was looked.
        sockets: all that were seen.
    """

    mark: str = field(default_factory=lambda: uuid.uuid4().hex)
    looks: int = 0
    sockets: set[Socket] = field(default_factory=set)
    _ours: dict[str, bool] = field(default_factory=dict)  # process -> whether it carries the mark

    @property
    def environment(self) -> dict[str, str]:
        """For whatever is to be watched."""
        return {**os.environ, MARK: self.mark}

    @property
    def open_to_others(self) -> list[Socket]:
        """Those that not only this machine reaches."""
        return sorted(socket for socket in self.sockets if not socket.is_local)

    def processes(self) -> list[str]:
        """Those that run now."""
        alive = [pid for pid in os.listdir("/proc") if pid.isdigit()]
        for pid in alive:
            if not self._ours.get(pid):  # it may be about to become ours
                with suppress(OSError):
                    self._ours[pid] = self.mark.encode() in _bytes(f"/proc/{pid}/environ")
        return [pid for pid in alive if self._ours.get(pid)]

    def look(self) -> None:
        """Note what is listened on now."""
        self.looks += 1
        waiting = dict(_waiting())
        for pid in self.processes():
            with suppress(OSError):
                for descriptor in os.scandir(f"/proc/{pid}/fd"):
                    found = waiting.get(_inode(descriptor.path))
                    if found:
                        program = _bytes(f"/proc/{pid}/cmdline").replace(b"\0", b" ")[:80]
                        self.sockets.add(Socket(*found, program.decode(errors="replace").strip()))


@contextmanager
def watched() -> Iterator[Watch]:
    """Look all the time while the block runs."""
    watch, over = Watch(), threading.Event()

    def look() -> None:
        while not over.wait(PERIOD_S):
            watch.look()

    thread = threading.Thread(target=look)
    thread.start()
    try:
        yield watch
    finally:
        over.set()
        thread.join()
        watch.look()


def _waiting() -> Iterator[tuple[str, tuple[str, str, int]]]:
    """Inode, and protocol, address and port, of every socket of this machine that waits."""
    for protocol, state in WAITING.items():
        with suppress(FileNotFoundError):  # without IPv6
            for line in Path(f"/proc/net/{protocol}").read_text().splitlines()[1:]:
                fields = line.split()
                if fields[3] == state:
                    host, port = fields[1].split(":")
                    yield fields[9], (protocol, _address(host), int(port, 16))


def _address(words: str) -> str:
    """An address as the kernel writes it: 32-bit words in this machine's order."""
    parts = [int(words[k : k + 8], 16) for k in range(0, len(words), 8)]
    packed = b"".join(struct.pack("=I", part) for part in parts)
    return str(ipaddress.ip_address(packed))


def _inode(descriptor: str) -> str:
    with suppress(OSError):
        name = os.readlink(descriptor)
        if name.startswith("socket:["):
            return name[8:-1]
    return ""


def _bytes(path: str) -> bytes:
    with open(path, "rb") as file:
        return file.read()
