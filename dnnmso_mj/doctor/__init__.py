"""What is missing on this machine for each part of the package, and how to get it.

It must answer where other parts cannot even be imported, so it uses the standard library alone and
looks at everything else from outside. `python -m dnnmso_mj.doctor` needs no command line library.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Literal

State = Literal["ok", "note", "missing", "broken"]


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Args:
        group: what it belongs to.
        name: of it.
        state: ok; note: worth knowing; missing: something optional; broken: runs cannot be trusted.
        detail: what was found.
        fix: what to do about it; empty where nothing is.
    """

    group: str
    name: str
    state: State
    detail: str
    fix: str = ""


def examine() -> list[Finding]:
    """Look at everything; what cannot be looked at is a finding of its own."""
    from dnnmso_mj.doctor.machine import machine
    from dnnmso_mj.doctor.packages import extras, packages
    from dnnmso_mj.doctor.self_check import self_check

    found: list[Finding] = []
    for look in (packages, extras, machine, self_check):
        found += _guarded(look)
    return found


def is_well(findings: list[Finding]) -> bool:
    """Whether all that every run needs is there."""
    return not any(finding.state == "broken" for finding in findings)


def document(findings: list[Finding]) -> str:
    """The findings as one JSON object."""
    status = "ok" if is_well(findings) else "broken"
    return json.dumps({"status": status, "findings": [asdict(finding) for finding in findings]})


def words(findings: list[Finding]) -> Iterator[str]:
    """The findings as lines for people, with what to do at once below each."""
    width = max(len(finding.name) for finding in findings)
    group = ""
    for finding in findings:
        if finding.group != group:
            group = finding.group
            yield f"{group}:"
        state = finding.state.upper() if finding.state == "broken" else finding.state
        yield f"  {state:8} {finding.name:{width}}  {finding.detail}"
        if finding.fix:
            yield f"  {'':8} {'':{width}}  → {finding.fix}"
    broken = [finding.name for finding in findings if finding.state == "broken"]
    missing = sum(finding.state == "missing" for finding in findings)
    if broken:
        yield f"broken: {', '.join(broken)}"
    else:
        optional = f"; optional and not here: {missing}" if missing else ""
        yield f"all that a run needs is here{optional}"


def _guarded(look: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    try:
        yield from look()
    except Exception as error:  # whatever a damaged installation raises
        what = f"could not be looked at: {type(error).__name__}: {error}"
        yield Finding(look.__name__, look.__name__, "broken", what)
