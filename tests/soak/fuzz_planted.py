"""A target that is really broken, to see that it is found: four bugs behind a word each."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

from dnnmso_mj.errors import ScenarioError

MAX_LEN = 64
BUGS = {b"key": "planted KeyError", b"slow": "slow", b"big": "large", b"die": "the process"}
WORDS = [word.decode() for word in BUGS]


def seeds(work: Path) -> list[bytes]:
    return [b"a", *([os.environ["PLANTED"].encode()] if "PLANTED" in os.environ else [])]


def strategy() -> Any:
    from hypothesis import strategies as st

    return st.binary(max_size=8)


def target(work: Path) -> Any:
    def tried(data: bytes) -> None:
        if data == b"key":
            raise KeyError("planted")
        if data == b"slow":
            time.sleep(1.2)
        if data == b"big":
            bytearray(b"x" * 300 * 2**20)
        if data == b"die":
            os.abort()
        raise ScenarioError("refused: allowed: nothing")

    return tried
