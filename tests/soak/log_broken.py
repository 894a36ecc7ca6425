"""Readers of logs that are broken on purpose, to see that the row finds it.

As a program: log_broken.py ORIGINAL HOW, then as `soak.log_worker`.
"""

from __future__ import annotations

import sys
from typing import Any

import lz4.frame

from dnnmso_mj.log import limits, prefix, records, rows


def leave_out() -> None:
    """Go on behind a damaged chunk as if it had never been."""
    whole = records.chunk

    def chunk(body: Any) -> bytes:
        try:
            return whole(body)
        except records.DamagedError:
            return b""

    records.chunk = chunk
    prefix._Order.following = lambda _self, messages: len(messages)
    rows.Rows._check_times = lambda _self, _times, _numbers: None


def unbound() -> None:
    """Decompress whatever there is."""
    limits.CHUNK = 1 << 40
    records._UNPACK["lz4"] = lambda data, _size: lz4.frame.decompress(data)


def believe() -> None:
    """Call every log whole."""
    prefix._Source.check_summary = lambda _self: None


if __name__ == "__main__":
    {"leave out": leave_out, "unbound": unbound, "believe": believe}[sys.argv.pop()]()
    from soak.log_worker import main

    main()
