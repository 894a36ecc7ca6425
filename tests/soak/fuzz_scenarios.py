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

MAX_LEN = 1000  # the parser takes 1 ms for each 700
DEEPEST = 6
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

    root = Shape.root()
    must = {
        key: _value(part, 1) for key in ("reference", "controller") if (part := root.child(key))
    }
    whole = st.builds(
        lambda some, more: {**more, "name": "x", **some},
        st.fixed_dictionaries(must),
        _group(root, 0),
    )
    return whole.map(lambda data: json.dumps(data).encode())


def _odd() -> Any:
    """What stands nowhere."""
    from hypothesis import strategies as st

    numbers = st.one_of(st.floats(), st.integers())
    return st.one_of(
        st.none(), st.booleans(), numbers, st.text(max_size=8), st.sampled_from([[], {}])
    )


def _value(shape: Shape, depth: int) -> Any:
    """Mostly what may stand at a place."""
    from hypothesis import strategies as st

    if shape.kinds:
        kinds = st.sampled_from(sorted(shape.kinds))
        return kinds.flatmap(lambda kind: _group(shape.kinds[kind], depth, kind))
    if shape.keys:
        return _group(shape, depth)
    usual: Any = st.sampled_from([1, 0.5, 10, -1, 0, "a", True, None, 1e-3])
    entry = shape.child(0)
    if shape.choices:
        usual = st.sampled_from(shape.choices)
    elif entry is not None and depth < DEEPEST:
        usual = st.one_of(st.lists(_value(entry, depth + 1), max_size=3), usual)
    return st.one_of(usual, usual, usual, _odd())


def _group(shape: Shape, depth: int, kind: str | None = None) -> Any:
    """Some of a part's keys, with their values."""
    from hypothesis import strategies as st

    if depth > DEEPEST:
        return _odd()
    parts = {key: shape.child(key) for key in shape.keys if key != "kind"}
    fixed = {} if kind is None else {"kind": st.just(kind)}
    names = st.lists(st.sampled_from(sorted(parts) or ["x"]), max_size=4, unique=True)

    def some(chosen: list[str]) -> Any:
        drawn = {name: _value(part, depth + 1) for name in chosen if (part := parts.get(name))}
        return st.fixed_dictionaries({**fixed, **drawn})

    return names.flatmap(some)


def mutate(data: bytes, rng: random.Random, raw: Callable[[bytes, int], bytes]) -> bytes:
    """Set something at a key path of the document, if it is one."""
    try:
        whole: Any = json.loads(data)
    except ValueError:
        root, _ = read_document(data.decode(errors="replace"))
        whole = root.plain() if root else None
    if not isinstance(whole, dict):
        return bytes(raw(data, MAX_LEN))
    for _ in range(rng.randint(1, 3)):
        _change(whole, rng)
    return json.dumps(whole).encode()


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
