"""Fuzzed: the text of a scenario's file."""

from __future__ import annotations

import json
import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dnnmso_mj.loading import load_scenario
from dnnmso_mj.loading.documents import read_document
from dnnmso_mj.loading.shape import Shape
from dnnmso_mj.paths import scenario_names, scenarios_dir
from soak.fuzz_words import PATHS, SCENARIO, VALUES, WORDS

MAX_LEN = 1500  # the parser takes 1 ms for each 700
__all__ = ["MAX_LEN", "WORDS", "mutate", "seeds", "strategy", "target"]


def seeds(work: Path) -> list[bytes]:
    os.mkfifo(work / "fifo")
    (work / "folder").mkdir()
    shipped = [(scenarios_dir() / f"{name}.yaml").read_bytes() for name in scenario_names()]
    small = [text for text in shipped if len(text) <= MAX_LEN]
    return [SCENARIO.encode(), b"name: a\n", b"[", b"a: &b {c: *b}", *small]


def target(work: Path) -> Any:
    file = work / "scenario.yaml"

    def tried(data: bytes) -> None:
        file.write_bytes(data)
        load_scenario(file)

    return tried


def strategy() -> Any:
    """Nearly valid scenarios, drawn from the schema, as JSON, which YAML holds."""
    from hypothesis import strategies as st

    odd = st.one_of(
        st.none(),
        st.booleans(),
        st.floats(),
        st.integers(),
        st.text(max_size=8),
        st.just([]),
        st.just({}),
    )

    def value(shape: Shape, depth: int) -> Any:
        if shape.kinds:
            return st.sampled_from(sorted(shape.kinds)).flatmap(
                lambda kind: group(shape.kinds[kind], depth, kind)
            )
        if shape.keys:
            return group(shape, depth)
        schema = shape.schema
        usual: Any = st.sampled_from([1, 0.5, 10, -1, 0, "a", True, None, 1e-3])
        if shape.choices:
            usual = st.sampled_from(shape.choices)
        elif "anyOf" in schema or schema.get("type") == "array":
            entry = shape.child(0)
            entries = value(entry, depth + 1) if entry is not None and depth < 6 else usual
            usual = st.one_of(st.lists(entries, max_size=3), usual)
        return st.one_of(usual, usual, usual, odd)

    def group(shape: Shape, depth: int, kind: str | None = None) -> Any:
        if depth > 6:
            return odd
        optional = {}
        for key in shape.keys:
            below = shape.child(key)
            if below is not None and key != "kind":
                optional[key] = st.deferred(lambda below=below: value(below, depth + 1))
        fixed = {} if kind is None else {"kind": st.just(kind)}
        few = st.lists(st.sampled_from(sorted(optional) or ["x"]), max_size=4, unique=True)
        return few.flatmap(
            lambda keys: st.fixed_dictionaries(
                {**fixed, **{k: optional[k] for k in keys if k in optional}}
            )
        )

    root = Shape.root()
    parts = {key: value(root.child(key), 1) for key in ("reference", "controller")}  # type: ignore[arg-type]
    whole = st.builds(
        lambda must, may: {**may, "name": "x", **must}, st.fixed_dictionaries(parts), group(root, 0)
    )
    return whole.map(lambda data: json.dumps(data).encode(errors="surrogatepass"))


def mutate(data: bytes, rng: random.Random, raw: Callable[[bytes, int], bytes]) -> bytes:
    """Set something at a key path of the document, if it is one."""
    text = data.decode(errors="replace")
    try:
        root, _ = read_document(text)
    except Exception:
        root = None
    if root is None or not isinstance(root.value, dict):
        return bytes(raw(data, MAX_LEN))
    whole: Any = root.plain()
    for _ in range(rng.randint(1, 3)):
        _change(whole, rng)
    return json.dumps(whole).encode(errors="surrogatepass")


def _change(here: Any, rng: random.Random) -> None:
    """Go down a key path, making what is missing, and put a value at its end."""
    path = rng.choice(PATHS).split(".")
    for key in path[:-1]:
        if isinstance(here, list):
            if not here:
                return
            here = here[0]
        elif isinstance(here, dict):
            here = here.setdefault(key, {})
        else:
            return
    if isinstance(here, dict):
        value = read_document(rng.choice(VALUES))[0]
        here[path[-1]] = value.plain() if value else None
