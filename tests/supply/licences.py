"""`make licences`: whether all that is installed may be used as we use it.

We ship none of it: a wheel names what it needs, and its user's pip brings that. So a licence must
let us use and test with it, unchanged; what would bind our own code is not allowed.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable
from importlib.metadata import Distribution, distributions

from packaging.utils import canonicalize_name

PERMISSIVE = {
    "0BSD", "Apache-2.0", "Apache-2.0 WITH LLVM-exception", "BSD", "BSD-2-Clause", "BSD-3-Clause",
    "BSL-1.0", "CC0-1.0", "ISC", "MIT", "MIT-CMU", "PSF-2.0", "Qhull", "Unlicense", "Zlib",
}  # fmt: skip
# Who changes one of these files must give that file on; nobody does so here.
COPYLEFT_OF_FILES = {
    "certifi": "MPL-2.0",
    "fqdn": "MPL-2.0",
    "hypothesis": "MPL-2.0",
    "pathspec": "MPL-2.0",
    "tqdm": "MPL-2.0 AND MIT",
}
# What authors write where an SPDX expression is meant.
MEANT = {
    "3-Clause BSD License": "BSD-3-Clause",
    "Apache 2.0": "Apache-2.0",
    "Apache Software License": "Apache-2.0",
    "BSD License": "BSD",
    "ISC License (ISCL)": "ISC",
    "MIT License": "MIT",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Python Software Foundation License": "PSF-2.0",
    "The Unlicense (Unlicense)": "Unlicense",
}
# Distributions whose metadata names none; read in their source, at that version.
UNNAMED = {("atheris", "3.0.0"): "Apache-2.0", ("cmeel-qhull", "8.0.2.1"): "Qhull"}


def licence(of: Distribution) -> str:
    """The licence that a distribution names, as an SPDX expression where it can be told; or ""."""
    about = of.metadata
    if about["License-Expression"]:
        return str(about["License-Expression"])
    named = [
        text.rpartition(" :: ")[2]
        for text in about.get_all("Classifier") or ()
        if text.startswith("License :: ") and text != "License :: OSI Approved"
    ]
    if not named:
        line = (about["License"] or "").strip().partition("\n")[0]
        named = [line] if line and line != "UNKNOWN" else []
    unnamed = UNNAMED.get((canonicalize_name(about["Name"]), of.version), "")
    return " AND ".join(MEANT.get(name, name) for name in named) or unnamed


def is_allowed(expression: str, allowed: Iterable[str] = PERMISSIVE) -> bool:
    """Whether an expression, without parentheses, lets us choose a licence that is allowed."""
    allowed = set(allowed)
    ways = re.split(r" OR ", expression)
    return any(all(part in allowed for part in way.split(" AND ")) for way in ways)


def refused(found: Iterable[Distribution]) -> list[str]:
    """Distributions that may not be used, or do not say: name, version and what they say."""
    out = []
    for one in found:
        name, said = canonicalize_name(one.metadata["Name"]), licence(one)
        if not is_allowed(said) and COPYLEFT_OF_FILES.get(name) != said:
            out.append(f"{name} {one.version}: {said or 'names no licence'}")
    return sorted(out)


def main() -> int:
    """Check the environment that this runs in; 1 if something in it is refused."""
    found = list(distributions())
    bad = refused(found)
    for line in bad:
        print(f"not allowed: {line}", file=sys.stderr)
    print(f"{len(found)} distributions, {len(bad)} not allowed")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
