"""Rerun's programs as tests see them from outside: processes, ports, and files."""

from __future__ import annotations

import os
import re
import urllib.parse
from pathlib import Path

from dnnmso_mj.viewer.process import LOCAL


def children() -> list[int]:
    """The Rerun programs that this process has started and that still run; each leads a group."""
    return processes(b"rerun_cli")


def processes(word: bytes) -> list[int]:
    """The children of this process whose command has a word in it."""
    pids = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
    return [int(pid) for pid in pids if word in Path(f"/proc/{pid}/cmdline").read_bytes()]


def ports_of(address: str) -> tuple[int, int]:
    """Of the page, and of the data that it loads."""
    url = urllib.parse.urlsplit(address)
    data = urllib.parse.parse_qs(url.query)["url"][0]
    assert data.startswith(f"rerun+http://{LOCAL}:")
    return int(url.port or 0), int(re.findall(r":(\d+)/proxy", data)[0])


def listening_addresses(port: int) -> set[str]:
    """Local addresses, as the kernel writes them, on which somebody listens at a port."""
    listening = "0A"
    return {
        address
        for table in ("/proc/net/tcp", "/proc/net/tcp6")
        for fields in (line.split() for line in Path(table).read_text().splitlines()[1:])
        for address, hex_port in [fields[1].split(":")]
        if int(hex_port, 16) == port and fields[3] == listening
    }


def contents(rrd: Path) -> dict[str, dict[str, list]]:
    """Entity -> component -> pairs of its tick (-1: it always holds) and its value, by their ticks.

    A property of the file as a whole, such as when it was begun, is no entity.
    """
    from rerun.chunk import RrdReader

    found: dict[str, dict[str, list]] = {}
    for chunk in RrdReader(rrd).stream():
        batch = chunk.to_record_batch()
        names = batch.schema.names
        ticks = batch["tick"].to_pylist() if "tick" in names else [-1] * len(batch)
        components = found.setdefault(chunk.entity_path, {})
        for name in (name for name in names if ":" in name):
            pairs = zip(ticks, batch[name].to_pylist(), strict=True)
            components.setdefault(name, []).extend(pairs)
    for pairs in (pairs for components in found.values() for pairs in components.values()):
        pairs.sort(key=lambda pair: pair[0])
    found.pop("/__properties", None)
    return found
