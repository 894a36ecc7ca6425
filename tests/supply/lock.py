"""`make lock`: the exact version and every hash of all that the Makefile installs.

`constraints.txt` says which versions. Each file of `requirements/` holds what its group needs
beyond the groups before it, so that together they hold each distribution once. torch is left out:
a machine may serve a build of its own, which brings other packages along than the plain one.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
CONSTRAINTS = ROOT / "constraints.txt"
GROUPS = {"run": "standard", "docs": "docs", "test": "test", "check": "check"}  # and their extras
PYTHONS = ("3.11.5", "3.12", "3.13", "3.14")
MACHINES = ("x86_64", "aarch64")
OWN_BUILD = "torch"
BROUGHT_BY_OWN_BUILD = ("nvidia-", "cuda-", "triton")
HEAD = """\
# Made by `make lock`: what the extra {extra} needs beyond the groups before it.
# Exact versions, of constraints.txt, and the hash of every file there is of each.
"""


@dataclass(frozen=True)
class Locked:
    """One distribution of a lock.

    Args:
        requirement: its exact version and, if it is not for all machines, for which.
        hashes: of every file that the registry has of that version, as pip takes them.
    """

    requirement: Requirement
    hashes: tuple[str, ...]

    @property
    def name(self) -> str:
        """As registries compare names."""
        return canonicalize_name(self.requirement.name)

    @property
    def version(self) -> str:
        """The exact version."""
        return str(self.requirement.specifier).removeprefix("==")

    @property
    def text(self) -> str:
        """As it stands in the file."""
        lines = [str(self.requirement), *(f"    --hash={each}" for each in self.hashes)]
        return " \\\n".join(lines) + "\n"

    @property
    def is_for_this_machine(self) -> bool:
        """Whether the interpreter that runs this wants it."""
        return self.requirement.marker is None or self.requirement.marker.evaluate()


def lock_file(group: str) -> Path:
    """Where a group's lock is."""
    return ROOT / "requirements" / f"{group}.txt"


def parse(text: str) -> dict[str, Locked]:
    """The distributions of a lock, by name; comments and options are no part of it."""
    joined = re.sub(r"\\\n", " ", text)
    found = {}
    for line in joined.splitlines():
        if not line.strip() or line.lstrip().startswith(("#", "--")):
            continue
        requirement, *hashes = line.split(" --hash=")
        one = Locked(Requirement(requirement), tuple(h.strip() for h in hashes))
        found[one.name] = one
    return found


def read_locks(groups: Iterable[str] = GROUPS) -> dict[str, Locked]:
    """All that some groups' locks hold, by name."""
    texts = "".join(lock_file(group).read_text(encoding="utf-8") for group in groups)
    return parse(texts)


def read_pins() -> dict[str, str]:
    """Versions of constraints.txt, by name."""
    return {one.name: one.version for one in parse(CONSTRAINTS.read_text("utf-8")).values()}


def settled(found: Mapping[str, Locked], pins: Mapping[str, str]) -> dict[str, Locked]:
    """What of it our machines install from the registry.

    Raises:
        SystemExit: something has no pin, another version than its pin, or no hash.
    """
    kept = {}
    for name, one in found.items():
        if name.startswith((OWN_BUILD, *BROUGHT_BY_OWN_BUILD)) or not is_for_our_machines(one):
            continue
        if pins.get(name) != one.version:
            sys.exit(f"{one.requirement}: constraints.txt says {pins.get(name)}; pin it there")
        if not one.hashes:
            sys.exit(f"{one.requirement}: the registry gives no hash")
        kept[name] = one
    return kept


def is_for_our_machines(one: Locked) -> bool:
    """Whether any Linux machine that we know wants it."""
    marker = one.requirement.marker
    places = (
        {
            "python_version": ".".join(python.split(".")[:2]),
            "python_full_version": python,
            "platform_machine": machine,
            "platform_python_implementation": "CPython",
            "implementation_name": "cpython",
            "sys_platform": "linux",
            "platform_system": "Linux",
            "os_name": "posix",
        }
        for python, machine in product(PYTHONS, MACHINES)
    )
    return marker is None or any(marker.evaluate(place) for place in places)


def resolve(extra: str) -> dict[str, Locked]:
    """All that an extra and the build of this package need, on any machine, with hashes."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    command = [sys.executable, "-m", "uv", "pip", "compile", "pyproject.toml", "-"]
    command += ["--extra", extra, "--constraint", CONSTRAINTS.name, "--universal"]
    command += ["--python-version", PYTHONS[0], "--generate-hashes"]
    command += ["--no-header", "--no-annotate", "--no-config", "--quiet"]
    done = subprocess.run(
        command,
        cwd=ROOT,
        env=os.environ | certificates(),
        input="\n".join(project["build-system"]["requires"]),
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    if done.returncode:
        sys.exit(f"no lock for the extra {extra}")
    return parse(done.stdout)


def certificates() -> dict[str, str]:
    """The certificates that pip was told to trust, for a resolver that does not ask pip."""
    return {"SSL_CERT_FILE": os.environ["PIP_CERT"]} if "PIP_CERT" in os.environ else {}


def main() -> None:
    """Write every group's lock."""
    pins = read_pins()
    before: dict[str, Locked] = {}
    for group, extra in GROUPS.items():
        new = settled(resolve(extra), pins)
        own = [new[name] for name in sorted(new.keys() - before.keys())]
        head = HEAD.format(extra=extra)
        lock_file(group).write_text(head + "".join(one.text for one in own), encoding="utf-8")
        before |= new
        print(f"{lock_file(group).relative_to(ROOT)}: {len(own)} distributions")
    stale = pins.keys() - before.keys() - {OWN_BUILD}
    if stale:
        sys.exit(f"constraints.txt pins what nothing needs: {', '.join(sorted(stale))}")


if __name__ == "__main__":
    main()
