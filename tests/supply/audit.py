"""`make audit`: known vulnerabilities of all that is locked, or that nobody could be asked.

pip-audit calls it clean when its service knew nothing of any package, and ends with the same status
for a vulnerability as for a network that is down. So its outcome is told from its report here.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from supply.lock import CONSTRAINTS

SECONDS = 60.0  # for all of it
ANSWER_SECONDS = 5  # for one answer of the service
PROBE = "packaging==24.0\n"  # any release that every service knows of


@dataclass(frozen=True)
class Audit:
    """How an audit ended.

    Args:
        audited: packages that the service knew, and gave its advisories of.
        findings: known vulnerabilities, in words.
        unanswered: why it was not run, or which packages it could not be asked about; or "".
    """

    audited: int
    findings: tuple[str, ...]
    unanswered: str

    @property
    def is_clean(self) -> bool:
        """Whether the service was asked about all of it, and knew of nothing."""
        return self.audited > 0 and not self.findings and not self.unanswered


def audit(pins: Path = CONSTRAINTS, service: Sequence[str] = (), seconds: float = SECONDS) -> Audit:
    """Ask for known vulnerabilities of exact versions.

    Args:
        pins: a file of them.
        service: pip-audit's options for another service than its own.
        seconds: after which the service counts as not reached.
    """
    command = [sys.executable, "-m", "pip_audit", "--requirement", str(pins), "--no-deps"]
    command += ["--disable-pip", "--format", "json", "--progress-spinner", "off", "--desc", "off"]
    command += ["--timeout", str(ANSWER_SECONDS), *service]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        return Audit(0, (), f"no answer of the advisory service within {seconds:g} s")
    try:
        packages = json.loads(done.stdout)["dependencies"]
    except (ValueError, KeyError):
        said = (done.stderr.strip() or "nothing was said").splitlines()[-1].split(":")[0]
        return Audit(0, (), f"the advisory service was not reached ({said})")
    return told(packages)


def told(packages: Sequence[dict[str, object]]) -> Audit:
    """What a report of pip-audit says of its packages."""
    skipped = [str(one["name"]) for one in packages if "skip_reason" in one]
    findings = tuple(
        f"{one['name']} {one['version']}: {found['id']}"
        for one in packages
        for found in one.get("vulns", ())  # type: ignore[attr-defined]
    )
    unanswered = ""
    if skipped:
        few = ", ".join(skipped[:5]) + (" …" if len(skipped) > 5 else "")
        unanswered = f"the advisory service did not answer for {len(skipped)} packages: {few}"
    return Audit(len(packages) - len(skipped), findings, unanswered)


def audit_all(folder: Path) -> Audit:
    """Audit every pin; where the service does not know one package that it must, only that one.

    Args:
        folder: for a file to ask with.
    """
    probe = folder / "probe.txt"
    probe.write_text(PROBE, encoding="utf-8")
    first = audit(probe, seconds=4 * ANSWER_SECONDS)
    if not first.audited:
        return first
    return audit()


def main() -> int:
    """0: clean; 1: vulnerabilities are known; 3: the service could not be asked about all."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        found = audit_all(Path(folder))
    for line in found.findings:
        print(f"vulnerable: {line}")
    if found.unanswered:
        print(f"NOT AUDITED: {found.unanswered}")
    print(f"{found.audited} distributions audited, {len(found.findings)} vulnerabilities known")
    return 1 if found.findings else 0 if found.is_clean else 3


if __name__ == "__main__":
    sys.exit(main())
