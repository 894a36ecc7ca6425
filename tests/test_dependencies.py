"""Every dependency has a row in CONTRIBUTING, a pin, and a place: the core, or an extra."""

from __future__ import annotations

import tomllib
from importlib.metadata import distribution, metadata, packages_distributions, version
from pathlib import Path

import pytest
from core_install import closure
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from supply.licences import licence as licence_of
from supply.lock import read_locks, read_pins

from dnnmso_mj.extras import EXTRAS

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
OWN = "dnnmso-mj"
FOR_DEVELOPERS = {"standard", "test", "check", "docs", "notebooks"}
WORDS = {"BSD-2-Clause": "BSD", "BSD-3-Clause": "BSD", "PSF-based": "matplotlib"}


def requirements(texts: list[str]) -> dict[str, Requirement]:
    found = (Requirement(text) for text in texts)
    return {canonicalize_name(item.name): item for item in found}


DIRECT = {
    extra: requirements(texts)
    for extra, texts in {
        "": PROJECT["dependencies"],
        **PROJECT["optional-dependencies"],
    }.items()
}


def rows() -> dict[str, list[str]]:
    """Cells of the table, by package."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").partition("## Dependencies\n")[2]
    lines = [line for line in text.splitlines() if line.startswith("| ")][1:]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {canonicalize_name(line[0]): line for line in cells}


def test_every_direct_dependency_has_a_row_under_its_extra_and_no_row_is_stale():
    asked = {(name, extra) for extra, items in DIRECT.items() for name in items if name != OWN}
    table = rows()
    assert set(table) == {name for name, _ in asked}
    for name, (_, extra, use, licence, instead) in table.items():
        assert (name, extra) in asked, f"{name} is not in the extra {extra!r}"
        assert use, name
        assert licence, name
        assert instead, name


@pytest.mark.parametrize("name", rows())
def test_the_licence_is_the_one_that_the_package_names(name):
    about = metadata(name)
    named = [about["License-Expression"], about["License"], *(about.get_all("Classifier") or ())]
    said = " ".join(text for text in named if text) or licence_of(distribution(name))
    licence = rows()[name][3]
    word = licence.split(" or ")[0].split(" and ")[0]
    stem = WORDS.get(word, word.removesuffix("-2.0"))
    assert stem in said, f"{licence} in the table; the package says {said[:200]}"


def test_every_extra_that_a_command_needs_is_known_with_all_of_its_modules():
    """`extras.py` holds what pyproject.toml says, so that messages name the right extra."""
    assert EXTRAS.keys() == PROJECT["optional-dependencies"].keys() - FOR_DEVELOPERS
    brings = packages_distributions()
    for name, extra in EXTRAS.items():
        assert set(extra.modules) == whole(name), name
        for package, module in extra.modules.items():
            assert package in map(canonicalize_name, brings[module]), module


def whole(extra: str) -> set[str]:
    """The packages of an extra and of those that it includes."""
    found = set()
    for name, item in DIRECT[extra].items():
        found |= {name} if name != OWN else set().union(*map(whole, item.extras))
    return found


def test_the_readmes_first_screen_is_what_make_run_installs():
    assert whole("standard") >= whole("viewer") | whole("plot") | whole("sweep")
    assert set(read_locks(["run"])) >= whole("standard")


def test_pins_are_true():
    """Each is what is installed here, within its range; each package that comes along has one."""
    pinned, locked = read_pins(), read_locks()
    for name, wanted in pinned.items():
        if name not in locked or locked[name].is_for_this_machine:
            assert version(name).split("+")[0] == wanted, name
    for items in DIRECT.values():
        for name, item in items.items():
            assert name == OWN or item.specifier.contains(pinned[name]), name
    texts = [str(item) for items in DIRECT.values() for name, item in items.items() if name != OWN]
    torch_brings = set(closure(["torch"])) - set(pinned)
    missing = set(closure(texts)) - set(pinned)
    assert missing <= torch_brings  # its plain package brings CUDA along, other builds do not
