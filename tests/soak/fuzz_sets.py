"""Fuzzed: `--set` strings, as a command line would give them."""

from __future__ import annotations

import os
import zlib
from copy import deepcopy
from pathlib import Path
from typing import Any

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.loading.documents import read_document
from dnnmso_mj.loading.overrides import apply_overrides, parse_overrides
from soak.fuzz_words import PATHS, SCENARIO, VALUES, WORDS

MAX_LEN = 512
BETWEEN = b"\0"  # no argument of a command holds one
WHOLE = 16  # one in so many is loaded whole, with all that costs
__all__ = ["MAX_LEN", "WORDS", "seeds", "strategy", "target"]


def seeds(work: Path) -> list[bytes]:
    """Also leaves things that a `--set` may name by path."""
    (work / "scenario.yaml").write_text(SCENARIO)
    os.mkfifo(work / "fifo")
    (work / "folder").mkdir()
    some = [f"{path}={value}" for path, value in zip(PATHS, VALUES * len(PATHS), strict=False)]
    return [text.encode() for text in some] + [BETWEEN.join(t.encode() for t in some[:3])]


def strategy() -> Any:
    from hypothesis import strategies as st

    keys = st.one_of(st.sampled_from(PATHS), st.text(max_size=20))
    values = st.one_of(
        st.sampled_from(VALUES),
        st.text(max_size=20),
        st.floats().map(repr),
        st.integers().map(str),
        st.lists(st.floats(width=16), max_size=5).map(repr),
    )
    one = st.builds("{}={}".format, keys, values)
    return st.lists(one, min_size=1, max_size=3).map(_encoded)


def _encoded(texts: list[str]) -> bytes:
    return BETWEEN.join(text.replace("\0", "").encode(errors="surrogatepass") for text in texts)


def target(work: Path) -> Any:
    scenario = work / "scenario.yaml"
    root, _ = read_document(SCENARIO)
    assert root is not None
    plain = root.plain()

    def tried(data: bytes) -> None:
        # As Python decodes its arguments.
        texts = [part.decode("utf-8", "surrogateescape") for part in data.split(BETWEEN)[:8]]
        if zlib.crc32(data) % WHOLE == 0:
            load_scenario(scenario, texts)
        elif apply_overrides(deepcopy(plain), parse_overrides(texts)):
            raise ScenarioError("a complaint")

    return tried
