"""Python and packages against the ranges that this package, and they themselves, declare."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, metadata, requires, version
from typing import TYPE_CHECKING

from dnnmso_mj.doctor import Finding, State
from dnnmso_mj.extras import EXTRAS, pip_install

if TYPE_CHECKING:
    from packaging.requirements import Requirement

PACKAGE = "dnnmso_mj"
# Pairs that their own metadata do not rule out: one from a version on, another, and why.
BAD_PAIRS = (("mujoco", "4", "dm-control", "dm-control 1.0.50 does not work on mujoco 4"),)


def packages() -> Iterator[Finding]:
    """Python, and every package that a run needs, with what these need in turn."""
    yield _python()
    yield Finding("packages", PACKAGE, "ok", version(PACKAGE))
    try:
        import packaging.requirements  # noqa: F401
    except ImportError:
        yield Finding("packages", "packaging", "broken", "not installed", "pip install packaging")
        return
    for requirement in direct(""):
        yield _package(requirement, "broken")
    yield from _bad_pairs()


def extras() -> Iterator[Finding]:
    """Each extra: whether it is there and in range, for what, and how to get it."""
    for name, extra in EXTRAS.items():
        missing = extra.missing
        if missing:
            detail = f"for {extra.use}; not installed: {', '.join(missing)}"
            yield Finding("extras", name, "missing", detail, pip_install(name))
            continue
        wrong = [found for item in direct(name) if (found := _package(item, "note")).state != "ok"]
        for found in wrong:
            yield Finding("extras", name, "note", f"{found.name}: {found.detail}", found.fix)
        if not wrong:
            yield Finding("extras", name, "ok", f"for {extra.use}")


def direct(extra: str) -> list[Requirement]:
    """What this package itself asks for: of the core (""), or of an extra and those it names."""
    from packaging.requirements import Requirement

    found = []
    for text in requires(PACKAGE) or ():
        item = Requirement(text)
        of_core, wanted = (_applies(item, name) for name in ("", extra))
        if not wanted or (extra and of_core):
            continue
        if item.name.replace("-", "_") == PACKAGE:
            for other in sorted(item.extras):
                found += direct(other)
        else:
            found.append(item)
    return found


def _applies(requirement: Requirement, extra: str) -> bool:
    return requirement.marker is None or requirement.marker.evaluate({"extra": extra})


def _python() -> Finding:
    here, wanted = platform.python_version(), metadata(PACKAGE)["Requires-Python"]
    try:
        from packaging.specifiers import SpecifierSet
    except ImportError:
        return Finding("packages", "Python", "note", f"{here}; wanted: {wanted}")
    if SpecifierSet(wanted).contains(here, prereleases=True):
        return Finding("packages", "Python", "ok", here)
    fix = "make clean, then make PYTHON=python3.12 run"
    return Finding("packages", "Python", "broken", f"{here}; allowed: {wanted}", fix)


def _package(requirement: Requirement, wrong: State) -> Finding:
    """A package's version against its range, and what it needs itself against theirs."""
    fix = f"pip install '{requirement.name}{requirement.specifier}'"
    try:
        here = version(requirement.name)
    except PackageNotFoundError:
        return Finding("packages", requirement.name, wrong, "not installed", fix)
    if not requirement.specifier.contains(here, prereleases=True):
        detail = f"{here}; allowed: {requirement.specifier}"
        return Finding("packages", requirement.name, wrong, detail, fix)
    unmet = list(_unmet(requirement.name))
    if unmet:
        detail = f"{here}, which needs {', '.join(text for text, _ in unmet)}"
        fix = f"pip install {' '.join(repr(want) for _, want in unmet)}"
        return Finding("packages", requirement.name, wrong, detail, fix)
    return Finding("packages", requirement.name, "ok", here)


def _unmet(name: str) -> Iterator[tuple[str, str]]:
    """What an installed package needs and has not: in words, and as pip takes it."""
    from packaging.requirements import Requirement

    for text in requires(name) or ():
        item = Requirement(text)
        if not _applies(item, ""):
            continue
        wanted = f"{item.name}{item.specifier}"
        try:
            here = version(item.name)
        except PackageNotFoundError:
            yield f"{wanted} (not installed)", wanted
            continue
        if not item.specifier.contains(here, prereleases=True):
            yield f"{wanted} ({here} is here)", wanted


def _bad_pairs() -> Iterator[Finding]:
    from packaging.version import Version

    for name, first_bad, other, why in BAD_PAIRS:
        try:
            here, _ = version(name), version(other)
        except PackageNotFoundError:
            continue
        if Version(here) >= Version(first_bad):
            fix = f"pip install '{name}<{first_bad}'"
            yield Finding("packages", f"{name}, {other}", "broken", why, fix)
