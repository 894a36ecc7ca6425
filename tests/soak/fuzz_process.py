"""One target, fuzzed in a process of its own: first by hypothesis, then by atheris.

`python -m soak.fuzz_process TARGET FOLDER SEED GENERATED MUTATED` writes FOLDER/found.json when so
many cases have been tried; FOLDER/now.bin always holds the case in hand.
"""

from __future__ import annotations

import importlib
import json
import os
import random
import sys
import warnings
from pathlib import Path
from typing import Any

import atheris

MODULES = {
    "sets": "fuzz_sets",
    "scenarios": "fuzz_scenarios",
    "logs": "fuzz_logs",
    "models": "fuzz_models",
    "planted": "fuzz_planted",
}
GUIDED = [
    "dnnmso_mj.loading",
    "dnnmso_mj.scenario",
    "dnnmso_mj.log",
    "dnnmso_mj.reading",
    "dnnmso_mj.wording",
    "dnnmso_mj.paths",
    "dnnmso_mj.assets",
    "dnnmso_mj.links",
    "dnnmso_mj.mjcf",
    "dnnmso_mj.recorded",
]  # not what numba compiles
RAW = 0.2  # of all cases, by atheris' own mutations alone
ANEW = 0.4  # of the others, from a real file: what reaches new code is mostly refused early
KEEP = 1000  # cases, after which what was found is written


def main() -> None:
    name, folder, seed = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])
    generated, mutated = int(sys.argv[4]), int(sys.argv[5])
    warnings.simplefilter("ignore")
    with atheris.instrument_imports(include=GUIDED):
        import dnnmso_mj.loading
        import dnnmso_mj.mjcf
        import dnnmso_mj.recorded  # noqa: F401
    part: Any = importlib.import_module(f"soak.{MODULES[name]}")
    from soak.fuzz_guard import Guard

    work, corpus = folder / "work", folder / "corpus"
    work.mkdir()
    corpus.mkdir()
    os.chdir(work)
    seeds = part.seeds(work)
    target = part.target(work)
    for seed_input in seeds[:3]:  # what is imported and kept once belongs to no case
        try:
            target(seed_input)
        except Exception:
            continue
    guard = Guard(target, folder / "now.bin")
    if generated:
        _generate(part, guard, seed, generated)
    for k, data in enumerate(seeds):
        (corpus / f"{k:03}").write_bytes(data)

    def case(data: bytes) -> None:
        known = len(guard.found.failures)
        guard(data)
        over = guard.found.cases >= generated + mutated
        if over or guard.found.cases % KEEP == 0 or len(guard.found.failures) > known:
            (folder / "found.json").write_text(json.dumps(guard.found.as_json()))
        if over:
            os._exit(0)

    _mutate(part, case, folder, seed, seeds)


def _generate(part: Any, guard: Any, seed: int, count: int) -> None:
    """Cases from a hypothesis strategy."""
    import hypothesis

    settings = hypothesis.settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )

    @hypothesis.seed(seed)
    @settings
    @hypothesis.given(part.strategy())
    def try_it(data: bytes) -> None:
        if guard.found.cases < count:
            guard(data)

    try_it()


def _mutate(part: Any, case: Any, folder: Path, seed: int, seeds: list[bytes]) -> None:
    """Cases that atheris mutates, those first that reach new code; never returns."""
    words = "\n".join(f'"{_escaped(word)}"' for word in dict.fromkeys(part.WORDS) if word)
    (folder / "words.txt").write_text(words + "\n")
    options = [
        f"-dict={folder}/words.txt",
        f"-seed={seed % 2**31 + 1}",  # 0 would mean any
        f"-max_len={part.MAX_LEN}",
        "-rss_limit_mb=4096",
        "-timeout=1000000",  # `fuzzing` sees to that, and its alarm may kill
        "-reload=0",
        "-len_control=0",
        "-mutate_depth=2",
        f"-artifact_prefix={folder}/",
        str(folder / "corpus"),
    ]
    own = getattr(part, "mutate", None)
    more: dict[str, Any] = {}
    if own:

        def mutate(data: bytes, longest: int, number: int) -> bytes:
            rng = random.Random(number)
            if rng.random() < RAW:
                return bytes(atheris.Mutate(data, longest))
            if rng.random() < ANEW:
                data = rng.choice(seeds)
            try:
                return bytes(own(data, rng, atheris.Mutate))[:longest]
            except Exception:  # what was broken before may be beyond surgery
                return bytes(atheris.Mutate(data, longest))

        more = {"custom_mutator": mutate}
    atheris.Setup([sys.argv[0], *options], case, **more)
    atheris.Fuzz()


def _escaped(word: str) -> str:
    """As a libFuzzer dictionary has it; its words are short."""
    return "".join(
        chr(byte) if 32 <= byte < 127 and byte not in b'"\\' else f"\\x{byte:02x}"
        for byte in word.encode()[:64]
    )


if __name__ == "__main__":
    main()
