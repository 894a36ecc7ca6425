"""`make sbom`: a bill of materials of an environment, as CycloneDX, and whether it is complete."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]


def write_sbom(out: Path, python: Path = Path(sys.executable), *, validate: bool = True) -> None:
    """Write what the environment of an interpreter holds; by default validated by the schema."""
    out.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "cyclonedx_py", "environment", str(python)]
    command += ["--pyproject", str(ROOT / "pyproject.toml"), "--output-reproducible"]
    command += ["--validate" if validate else "--no-validate", "--output-file", str(out)]
    subprocess.run(command, check=True, capture_output=True)


def read_sbom(path: Path) -> dict[str, Any]:
    """A bill of materials."""
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found


def differences(sbom: Mapping[str, Any], installed: Mapping[str, str]) -> list[str]:
    """Where a bill and an environment (versions by name) are not the same, in words."""
    if sbom.get("bomFormat") != "CycloneDX":
        return ["not a CycloneDX bill"]
    root = sbom["metadata"]["component"]
    named = {
        canonicalize_name(one["name"]): one["version"].partition("+")[0]
        for one in [root, *sbom["components"]]
    }
    out = [f"{name} {version} is not in the bill" for name, version in installed.items()
           if named.get(name) != version]  # fmt: skip
    return out + [f"{name} is not installed" for name in named.keys() - installed.keys()]


if __name__ == "__main__":
    write_sbom(Path(sys.argv[1]))
    print(f"{sys.argv[1]}: {len(read_sbom(Path(sys.argv[1]))['components'])} components")
