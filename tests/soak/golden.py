"""Hashes of runs that are never to change, for each machine and each set of versions.

`make golden` writes those of this machine into tests/golden.json; nothing else does. Code is
compiled for the processor that it runs on, and libraries choose among their own routines by it, so
that runs are the same to the last bit only on processors with the same features.
"""

from __future__ import annotations

import hashlib
import json
import platform
import tempfile
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

import llvmlite.binding as llvm

from dnnmso_mj import simulate
from soak.sameness import columns_digest
from soak.trials import trials

FILE = Path(__file__).parents[1] / "golden.json"
COMMAND = "make golden"
PACKAGES = ("mujoco", "numpy", "numba", "llvmlite")
Hashes = dict[str, str]  # trial -> SHA-256 of its columns


def key() -> str:
    """All that the last bit of a run depends on, but for the code of this package."""
    features = llvm.get_host_cpu_features().flatten()
    short = hashlib.sha256(features.encode()).hexdigest()[:12]
    packages = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    python = ".".join(platform.python_version_tuple()[:2])
    return (
        f"{platform.machine()} {llvm.get_host_cpu_name()} {short}, "
        f"{' '.join(platform.libc_ver())}, python {python}, {packages}"
    )


def measured() -> Hashes:
    """The hashes as they are now."""
    with tempfile.TemporaryDirectory() as folder:
        asked = trials(Path(folder), seed=0, duration=0.5)
        return {name: columns_digest(simulate(t.scenario())) for name, t in asked.items()}


def known() -> dict[str, Hashes]:
    """The hashes that are kept, by key."""
    found: dict[str, Hashes] = json.loads(FILE.read_text()) if FILE.exists() else {}
    return found


def differing(kept: Mapping[str, str], found: Mapping[str, str]) -> list[str]:
    """What is not as it was, in words."""
    return [
        f"{name}: {found.get(name, 'no run')[:12]}, and not {kept.get(name, 'any known')[:12]}; "
        f"if it is to be so: {COMMAND}"
        for name in sorted({*kept, *found})
        if kept.get(name) != found.get(name)
    ]


def missing() -> str:
    """What is said where this machine has no hashes."""
    return f"none for {key()}; {COMMAND}"


def main() -> None:
    """Write this machine's hashes; others stay."""
    kept = known() | {key(): measured()}
    FILE.write_text(json.dumps(dict(sorted(kept.items())), indent=1) + "\n")
    print(f"{FILE}: {key()}")


if __name__ == "__main__":
    main()
