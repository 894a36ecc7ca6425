"""Wheel and sdist: built from what belongs to the project, and looked into."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).parents[2]
IN_WHEEL = {"dnnmso_mj": "dnnmso_mj"} | {
    folder: f"dnnmso_mj/data/{folder}" for folder in ("models", "scenarios")
}
ABOUT = ("METADATA", "WHEEL", "entry_points.txt", "licenses/LICENSE", "RECORD")
ONLY_IN_GIT = {".gitignore", ".gitattributes"}  # of our files, what an sdist does without
MADE = {"PKG-INFO", ".gitignore"}  # what a build puts into an sdist itself


def our_files(root: Path = ROOT) -> list[str]:
    """Files of the project: those git knows or would take; in an unpacked sdist, all of them."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    if (root / ".git").exists():
        listed = subprocess.run(command, cwd=root, check=True, capture_output=True, text=True)
        names = listed.stdout.split("\0")
    else:
        names = [str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()]
        made = ("__pycache__", ".venv", ".pytest_cache", ".hypothesis", "dist", "site")
        names = [name for name in names if not set(made) & set(Path(name).parts)]
        names = [name for name in names if name == "logs/README.md" or name[:5] != "logs/"]
    return sorted(name for name in names if name and (root / name).is_file())


def copy_tree(to: Path, root: Path = ROOT) -> None:
    """The project's files alone, with their modes."""
    for name in our_files(root):
        (to / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(root / name, to / name)


def build(source: Path, out: Path, *kinds: str) -> list[Path]:
    """Build from a source tree into an empty folder: `--wheel`, `--sdist`, or one from the other.

    Raises:
        subprocess.CalledProcessError: the build failed.
    """
    command = [sys.executable, "-m", "build", "--no-isolation", *kinds, "--outdir", str(out)]
    subprocess.run([*command, str(source)], check=True, capture_output=True)
    return sorted(out.iterdir(), key=lambda path: path.suffix)  # .gz before .whl


def wheel_names(files: Iterable[str], name: str) -> set[str]:
    """What a wheel holds that is made of these files of the project and has this name."""
    found = set()
    for file in files:
        top, _, below = file.partition("/")
        if top in IN_WHEEL and below:
            found.add(f"{IN_WHEEL[top]}/{below}")
    about = "-".join(name.split("-")[:2]) + ".dist-info"
    return found | {f"{about}/{one}" for one in ABOUT}


def members(archive: Path) -> dict[str, bytes]:
    """Every file of a wheel or an sdist, the latter without its top folder."""
    if archive.suffix == ".whl":
        with zipfile.ZipFile(archive) as opened:
            return {one: opened.read(one) for one in opened.namelist() if one[-1] != "/"}
    found = {}
    with tarfile.open(archive) as opened:
        for one in opened.getmembers():
            file = opened.extractfile(one)
            assert file is not None, f"{one.name} is no plain file"
            found[one.name.partition("/")[2]] = file.read()
    return found


def unpack(sdist: Path, to: Path) -> Path:
    """An sdist's own folder, unpacked."""
    with tarfile.open(sdist) as opened:
        opened.extractall(to, filter="data")
    return to / sdist.name.removesuffix(".tar.gz")
