"""What is installed and built; and what the checks of it must refuse."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from email.message import Message
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.metadata import Distribution
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from soak.proof import measure
from soak.rows import row_of
from soak.supply_chain import LOCK_LINE
from soak.tally import Form
from supply import artifacts, licences, lock, sbom
from supply.audit import Audit, audit, told


def test_what_is_installed_is_known_licensed_and_built_clean(tmp_path: Path) -> None:
    """All of it but the audit, which may find nobody to ask; then the scorecard says so."""
    found = measure(row_of(14), Form(), tmp_path)
    assert not found["lost"], found["lost_first"]
    assert not found["let_in"], found["let_in_first"]
    assert found["not_run"].keys() <= {"vulnerability audit"}
    assert found["passed"] == (not found["not_run"])


class Advisories(BaseHTTPRequestHandler):
    """A service of advisories, as OSV speaks, that knows of one."""

    def do_POST(self) -> None:
        asked = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        known = {"id": "TEST-1", "summary": "", "details": "", "affected": [], "aliases": []}
        vulns = [known] if asked["package"]["name"] == "jinja2" else []
        answer = json.dumps({"vulns": vulns} if vulns else {}).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(answer)))
        self.end_headers()
        self.wfile.write(answer)

    def log_message(self, *args: Any) -> None:
        """Nothing is printed."""


@pytest.fixture
def service() -> Iterator[tuple[str, ...]]:
    """Options of an audit that asks a service of our own."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), Advisories)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield ("--vulnerability-service", "osv", "--osv-url", f"http://127.0.0.1:{server.server_port}/")
    server.shutdown()
    server.server_close()


def asked(folder: Path, text: str) -> Path:
    """A file of pins."""
    path = folder / "pins.txt"
    path.write_text(text)
    return path


def test_an_audit_tells_clean_from_vulnerable_from_not_asked(
    tmp_path: Path, service: tuple[str, ...]
) -> None:
    pins = asked(tmp_path, "packaging==24.0\n")
    clean = audit(pins, service)
    assert clean == Audit(1, (), "")
    assert clean.is_clean
    found = audit(asked(tmp_path, "jinja2==3.1.6\npackaging==24.0\n"), service)
    assert found.findings == ("jinja2 3.1.6: TEST-1",)
    assert not found.is_clean
    nobody = audit(pins, (*service[:-1], "http://127.0.0.1:9/"))
    assert nobody.audited == 0
    assert "not reached" in nobody.unanswered
    assert not nobody.is_clean


def test_a_package_that_the_service_does_not_know_is_not_clean() -> None:
    """pip-audit itself calls this clean, and ends with status 0."""
    found = told([{"name": "a", "version": "1", "vulns": []}, {"name": "b", "skip_reason": "?"}])
    assert found.audited == 1
    assert found.unanswered == "the advisory service did not answer for 1 packages: b"
    assert not found.is_clean
    assert not told([]).is_clean


class Told(Distribution):
    """A distribution that says this of itself."""

    def __init__(self, name: str, **said: str) -> None:
        self.about = Message()
        self.about["Name"], self.about["Version"] = name, "1.0"
        for key, value in said.items():
            self.about[key.replace("_", "-")] = value

    @property
    def metadata(self) -> Any:
        return self.about

    def read_text(self, filename: str) -> None:
        return None

    def locate_file(self, path: Any) -> Path:
        return Path(path)


@pytest.mark.parametrize(
    ("said", "refused"),
    [
        ({"License_Expression": "MIT"}, False),
        ({"License_Expression": "GPL-3.0-only OR MIT"}, False),
        ({"License_Expression": "MIT AND GPL-3.0-only"}, True),
        ({"License_Expression": "MPL-2.0"}, True),
        ({"License_Expression": "(MIT OR ISC) AND GPL-3.0-only"}, True),
        ({"Classifier": "License :: OSI Approved :: BSD License"}, False),
        ({"Classifier": "License :: OSI Approved"}, True),
        ({"License": "Apache 2.0"}, False),
        ({"License": "All rights reserved"}, True),
        ({"License": "UNKNOWN"}, True),
        ({}, True),
    ],
)
def test_a_licence_that_is_unknown_or_binds_us_is_refused_by_name(
    said: dict[str, str], refused: bool
) -> None:
    found = licences.refused([Told("thing", **said)])
    assert bool(found) == refused
    assert all(line.startswith("thing 1.0: ") for line in found)


def test_a_file_level_copyleft_is_for_those_packages_alone() -> None:
    mpl = "MPL-2.0"
    assert licences.refused([Told("certifi", License_Expression=mpl)]) == []
    assert licences.refused([Told("certifi", License_Expression="GPL-3.0-only")])


@pytest.mark.parametrize(
    "line",
    [
        "--index-url https://example.org/simple",
        "--find-links wheels",
        "thing @ https://example.org/thing.whl",
        "thing>=1.0",
        "thing==1.0",
        "    --hash=md5:d41d8cd98f00b204e9800998ecf8427e",
        "./wheels/thing.whl",
    ],
)
def test_a_lock_names_no_place_and_nothing_without_a_hash(line: str) -> None:
    assert not LOCK_LINE.fullmatch(line)


def test_a_lock_is_read_as_it_is_written() -> None:
    one = lock.Locked(Requirement("a==1.0; python_version < '3.13'"), ("sha256:0", "sha256:1"))
    assert lock.parse("# said\n" + one.text) == {"a": one}


def test_what_has_no_pin_or_no_hash_is_not_locked() -> None:
    here = lock.parse("a==1.0 --hash=sha256:0\ntorch==1 --hash=sha256:0\n")
    assert lock.settled(here, {"a": "1.0"}).keys() == {"a"}
    for pins in ({}, {"a": "1.1"}):
        with pytest.raises(SystemExit, match="pin it there"):
            lock.settled(here, pins)
    with pytest.raises(SystemExit, match="no hash"):
        lock.settled(lock.parse("a==1.0\n"), {"a": "1.0"})
    elsewhere = lock.parse("a==1.0 ; sys_platform == 'win32' --hash=sha256:0\n")
    assert lock.settled(elsewhere, {}) == {}


def test_a_bill_that_leaves_something_out_or_makes_it_up_is_found_out() -> None:
    bill = {
        "bomFormat": "CycloneDX",
        "metadata": {"component": {"name": "dnnmso_mj", "version": "0.1.0"}},
        "components": [{"name": "NumPy", "version": "2.0"}],
    }
    assert sbom.differences(bill, {"dnnmso-mj": "0.1.0", "numpy": "2.0"}) == []
    assert sbom.differences(bill, {"dnnmso-mj": "0.1.0", "numpy": "2.1"})
    assert sbom.differences(bill, {"dnnmso-mj": "0.1.0"}) == ["numpy is not installed"]


def test_the_files_of_a_wheel_are_the_packages_and_what_ships() -> None:
    names = artifacts.wheel_names(
        ["dnnmso_mj/a.py", "models/b.xml", "tests/c.py", "README.md"],
        "dnnmso_mj-1-py3-none-any.whl",
    )
    about = {f"dnnmso_mj-1.dist-info/{name}" for name in artifacts.ABOUT}
    assert names == {"dnnmso_mj/a.py", "dnnmso_mj/data/models/b.xml"} | about
