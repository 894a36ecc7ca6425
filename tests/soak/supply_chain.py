"""Row 14: what is installed is locked, licensed and audited; what is built is ours, and works."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import distributions
from pathlib import Path

from core_install import closure
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from supply import artifacts, audit, environment, licences, lock, sbom

from soak.tally import Form, Tally

ROOT = Path(__file__).parents[2]
LOCK_LINE = re.compile(
    r"#.*|[a-z0-9.-]+==[\w.]+(; [^/:]+)? \\|    --hash=sha256:[0-9a-f]{64}( \\)?|"
)
OURS = "dnnmso-mj"
# Nobody wants these in an artifact; all lie about where people work.
PLANTED = (
    ".env", ".netrc", ".venv/lib/secret.py", ".hypothesis/secret", "dist/secret.whl",
    "logs/secret.mcap", "site/secret.html", "dnnmso_mj/__pycache__/secret.pyc", "dnnmso_mj/.env",
    "dnnmso_mj/.secret.py.swp", "models/.env", "scenarios/.env", "tests/__pycache__/secret.pyc",
    "id_rsa", "tests/.env", ".idea/secret.xml", "docs/.env",
)  # fmt: skip
# What the suite has that needs the package's sources beside it, or is this very row.
NOT_FROM_A_WHEEL = (
    "--ignore-glob=tests/test_soak*",
    "--ignore=tests/test_site.py",
    "--ignore=tests/test_unsafe_code.py",
    "--deselect=tests/test_paths.py::test_an_installed_wheel_finds_its_models_and_scenarios",
    "--deselect=tests/test_paths.py::test_a_checkout_has_models_and_scenarios_at_its_top",
    "--deselect=tests/test_docs.py::test_every_link_on_the_page_leads_to_a_file",
)
TELLING = ("tests/test_paths.py", "tests/test_links.py", "tests/test_reference.py")


def own_requirements() -> dict[str, list[str]]:
    """What each extra asks for of others, by extra; what all need under ""."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    asked = {"": project["dependencies"], **project["optional-dependencies"]}

    def whole(extra: str) -> list[str]:
        out = []
        for text in asked[extra]:
            item = Requirement(text)
            if canonicalize_name(item.name) == OURS:
                out += [one for name in item.extras for one in whole(name)]
            else:
                out.append(text)
        return out

    return {extra: whole(extra) for extra in asked}


def lock_is_complete(tally: Tally) -> None:
    """Files alone: every pin has a lock with hashes, and every lock a pin in its range."""
    pins, asked = lock.read_pins(), own_requirements()
    locked: dict[str, lock.Locked] = {}
    for group, extra in lock.GROUPS.items():
        text = lock.lock_file(group).read_text(encoding="utf-8")
        own = lock.parse(text)
        with tally.case(f"lock {group}"):
            stray = [line for line in text.splitlines() if not LOCK_LINE.fullmatch(line)]
            assert not stray, f"more than names, versions and hashes: {stray[0]}"
            assert not own.keys() & locked.keys(), "what another group has already"
            for one in own.values():
                assert one.hashes, f"{one.name} has no hash"
                assert pins.get(one.name) == one.version, f"{one.name}: another pin"
        locked |= own
        with tally.case(f"all that the extra {extra} needs is in {group} or before"):
            needed = {name for name in closure(asked[""] + asked[extra]) if is_to_be_locked(name)}
            assert not needed - locked.keys(), f"not locked: {sorted(needed - locked.keys())}"
    with tally.case("every pin is locked"):
        assert pins.keys() - locked.keys() == {lock.OWN_BUILD}
    for extra, texts in asked.items():
        with tally.case(f"pins are in the ranges of {extra or 'the core'}"):
            for item in map(Requirement, texts):
                pin = pins[canonicalize_name(item.name)]
                assert item.specifier.contains(pin), f"{item}, but {pin}"


def is_to_be_locked(name: str) -> bool:
    """Whether a distribution is not torch, nor brought by a build of it alone."""
    return not name.startswith((lock.OWN_BUILD, *lock.BROUGHT_BY_OWN_BUILD))


def installs_check_hashes(tally: Tally) -> None:
    """What `make` does to install: each lock with its hashes, nothing else but torch and us."""
    for group in lock.GROUPS:
        command = ["make", "--dry-run", "--always-make", f".venv/.installed-{group}"]
        done = subprocess.run(
            command, cwd=ROOT, env=environment.clean_environment(), check=True,
            capture_output=True, text=True,
        )  # fmt: skip
        lines = [line for line in done.stdout.splitlines() if "pip install" in line]
        with tally.case(f"make installs {group} as locked"):
            assert any(f"requirements/{group}.txt" in line for line in lines), (
                "its lock is not used"
            )
            for line in lines:
                said = line.partition("pip install")[2].split()
                asked = [word for word in said if not word.startswith("-")]
                locked = {"--require-hashes", "--no-deps", "--only-binary"} <= set(said)
                ours = {"--no-deps", "--no-build-isolation", "--editable"} <= set(said)
                torch = asked == ["constraints.txt", "torch"]
                assert locked or ours or torch, line


def pip_refuses_another_file(tally: Tally, wheel: Path, folder: Path) -> None:
    """A file that is not the locked one does not get in, as `make` calls pip."""
    listed = folder / "listed.txt"
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--require-hashes"]
    command += ["--no-deps", "--only-binary", ":all:", "--no-index", "--ignore-installed"]
    command += ["--find-links", str(wheel.parent), "--requirement", str(listed)]
    name, version = wheel.name.split("-")[:2]
    done = subprocess.run(
        [sys.executable, "-m", "pip", "hash", str(wheel)],
        check=True,
        capture_output=True,
        text=True,
    )
    right = done.stdout.split("--hash=")[1].strip()
    wrong = right[:-1] + ("0" if right[-1] != "0" else "1")
    for what, hashed in ("right", f" --hash={right}"), ("wrong", f" --hash={wrong}"), ("no", ""):
        listed.write_text(f"{name}=={version}{hashed}\n")
        taken = subprocess.run(command, capture_output=True, check=False).returncode == 0
        if what == "right" and not taken:
            tally.lose("pip does not take the locked file")
        elif what != "right" and taken:
            tally.admit(f"pip takes a file with {what} hash")
        else:
            tally.survive()


def licensed(tally: Tally, names: list[str]) -> None:
    """No distribution has a licence that is not allowed."""
    for line in names:
        tally.admit(f"licence of {line}")
    if not names:
        tally.survive()


def audited(tally: Tally, folder: Path) -> None:
    """No vulnerability is known of what is locked, or it is said that nobody could be asked."""
    found = audit.audit_all(folder)
    tally.figure("distributions audited", found.audited)
    for line in found.findings:
        tally.admit(f"known vulnerability: {line}")
    if found.unanswered:
        tally.leave_out("vulnerability audit", found.unanswered)
    if found.is_clean:
        tally.survive()


def billed(tally: Tally, folder: Path, python: Path, *, validate: bool) -> None:
    """The bill of materials holds what the environment does."""
    out = folder / "sbom.json"
    with tally.case("bill of materials"):
        sbom.write_sbom(out, python, validate=validate)
        wrong = sbom.differences(sbom.read_sbom(out), environment.versions(python))
        assert not wrong, "; ".join(wrong[:5])


def built(tally: Tally, folder: Path) -> tuple[Path, Path]:
    """Sdist and wheel of the project's files: the same bytes from anywhere, and no file more."""
    source, elsewhere = folder / "source", folder / "else" / "where"
    artifacts.copy_tree(source)
    files = artifacts.our_files()
    for name in PLANTED:
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_text("secret")
    artifacts.copy_tree(elsewhere)
    for path in elsewhere.rglob("*"):
        os.utime(path, (1e9, 1e9))
    sdist, wheel = artifacts.build(source, folder / "dist")
    again = artifacts.build(elsewhere, folder / "again")
    (alone,) = artifacts.build(elsewhere, folder / "alone", "--wheel")
    with tally.case("two builds are byte-equal"):
        assert [path.name for path in again] == [sdist.name, wheel.name]
        assert again[1].read_bytes() == wheel.read_bytes(), "the wheels differ"
        same = artifacts.members(again[0]).keys() ^ artifacts.members(sdist).keys()
        assert not same, f"the sdists differ: {sorted(same)[:5]}"
        assert again[0].read_bytes() == sdist.read_bytes(), "the sdists differ"
    with tally.case("the sdist gives the same wheel as the tree"):
        assert alone.read_bytes() == wheel.read_bytes()
    for kind, archive, wanted in (
        ("wheel", wheel, artifacts.wheel_names(files, wheel.name)),
        ("sdist", sdist, {*files, "PKG-INFO"}),
    ):
        held = artifacts.members(archive)
        for name in sorted(held.keys() - wanted):
            tally.admit(f"{name} in the {kind}")
        for name in sorted(wanted - held.keys()):
            tally.lose(f"{name} is not in the {kind}")
        tally.survive(len(wanted & held.keys()))
        tally.figure(f"files in the {kind}", len(held))
    return sdist, wheel


def without_sources(sdist: Path, folder: Path) -> Path:
    """The unpacked sdist without the package: its tests can only import what is installed."""
    tree = artifacts.unpack(sdist, folder)
    shutil.rmtree(tree / "dnnmso_mj")
    return tree


def fresh(sdist: Path, wheel: Path, folder: Path) -> tuple[Path, Path]:
    """A tree of tests, and the interpreter of a new environment with all that is locked.

    Raises:
        subprocess.CalledProcessError: it cannot be installed.
    """
    tree = artifacts.unpack(sdist, folder)
    env = environment.clean_environment() | {"PIP_NO_CACHE_DIR": "1"}
    make = ["make", f"PYTHON={Path(sys.base_prefix) / 'bin' / 'python3'}", ".venv/.installed-check"]
    subprocess.run(make, cwd=tree, env=env, check=True, capture_output=True)
    python = tree / ".venv" / "bin" / "python"
    ours = [str(python), "-m", "pip", "install", "--no-deps", "--no-index", "--force-reinstall"]
    subprocess.run([*ours, str(wheel)], cwd=tree, env=env, check=True, capture_output=True)
    shutil.rmtree(tree / "dnnmso_mj")
    return tree, python


def suite(tally: Tally, tree: Path, python: Path, *what: str, warm: bool) -> None:
    """Tests, in that tree, of the package that this interpreter has."""
    env = environment.clean_environment() | ({} if warm else {"DNNMSO_SKIP_WARM_UP": "1"})
    where = [str(python), "-c", "import dnnmso_mj; print(dnnmso_mj.__file__)"]
    found = subprocess.run(where, cwd=tree, env=env, check=True, capture_output=True, text=True)
    with tally.case("what is tested is what was installed"):
        assert Path(found.stdout.strip()).is_relative_to(python.parents[1]), found.stdout
    command = [str(python), "-m", "pytest", "-p", "no:cacheprovider", "-rfEs", *what]
    done = subprocess.run(
        [*command, *NOT_FROM_A_WHEEL],
        cwd=tree,
        env=env,
        capture_output=True,
        text=True,
        check=False,
    )
    last = (done.stdout.strip().splitlines() or [""])[-1]
    counted = re.findall(r"(\d+) (passed|failed|errors?|skipped)", last)
    counts = {word: int(number) for number, word in counted}
    tally.survive(counts.get("passed", 0))
    tally.figure("tests passed from the installed wheel", counts.get("passed", 0))
    for line in re.findall(r"^(?:FAILED|ERROR) .*", done.stdout, re.MULTILINE):
        tally.lose(f"from the wheel: {line}")
    for line in re.findall(r"^SKIPPED .*", done.stdout, re.MULTILINE):
        tally.leave_out(f"from the wheel: {line}", "skipped")
    if done.returncode and not counts.keys() - {"passed", "skipped"}:
        tally.lose(f"pytest ended with status {done.returncode}: {last or done.stderr[-200:]}")


def runs(tree: Path, python: Path) -> None:
    """A run, by the installed wheel alone, of what ships in it."""
    command = [str(python), "-m", "dnnmso_mj", "run", "paper_no_network", "--json", "--no-plot"]
    env = environment.clean_environment()
    done = subprocess.run(
        [*command, "--set", "duration=0.1"],
        cwd=tree.parent,
        env=env,
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr.decode()[-300:]
    assert json.loads(done.stdout)["status"] == "ok"


def run(form: Form, tally: Tally, folder: Path) -> None:
    """See the module."""
    lock_is_complete(tally)
    installs_check_hashes(tally)
    audited(tally, folder)
    sdist, wheel = built(tally, folder)
    pip_refuses_another_file(tally, wheel, folder)
    if form.long:
        tree, python = fresh(sdist, wheel, folder)
        installed = environment.versions(python)
        with tally.case("what is installed is what is locked"):
            locked = lock.read_locks(lock.GROUPS).values()
            here = {one.name for one in locked if one.is_for_this_machine}
            pins = lock.read_pins()
            others = {n for n in installed if is_to_be_locked(n)} - here - {OURS}
            assert not others, f"not locked: {sorted(others)}"
            assert not here - installed.keys(), f"not there: {sorted(here - installed.keys())}"
            assert all(installed[name] == pins[name] for name in here | {lock.OWN_BUILD})
        site = next((tree / ".venv" / "lib").glob("python*/site-packages"))
        licensed(tally, licences.refused(distributions(path=[str(site)])))
        billed(tally, folder, python, validate=True)
        tally.figure("left out by design", NOT_FROM_A_WHEEL)
        suite(tally, tree, python, "--numprocesses=logical", "--dist=loadfile", warm=True)
    else:
        asked = own_requirements()
        licensed(tally, licences.refused(closure(asked[""] + asked["check"]).values()))
        billed(tally, folder, Path(sys.executable), validate=False)
        tree = without_sources(sdist, folder)
        python = environment.overlay(folder / "venv", wheel)
        suite(tally, tree, python, *TELLING, warm=False)
        with tally.case("a run of the installed wheel"):
            runs(tree, python)
