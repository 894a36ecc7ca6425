"""A target that is really broken, to see that it is found: four bugs, behind a word each."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

from dnnmso_mj.errors import ScenarioError

MAX_LEN = 64
WORDS = ["key", "slow", "big", "die"]


def seeds(work: Path) -> list[bytes]:
    return [b"a"]


def strategy() -> Any:
    from hypothesis import strategies as st

    return st.binary(max_size=8)


def target(work: Path) -> Any:
    slow: list[bytes] = []

    def tried(data: bytes) -> None:
        if b"key" in data:
            raise KeyError("planted")
        if b"slow" in data and (not slow or data in slow):
            slow.append(data)
            time.sleep(1.1)
        if b"big" in data:
            bytearray(bytes(300 * 2**20))
        if b"die" in data:
            os.abort()
        raise ScenarioError("refused: allowed: nothing")

    return tried
