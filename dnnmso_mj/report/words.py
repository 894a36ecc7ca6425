"""Numbers and provenance as a report writes them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dnnmso_mj.sweep.statistics import Spread


def value(number: Any) -> str:
    """A number in four digits; a dash for none."""
    if number is None:
        return "–"
    if not isinstance(number, float):
        return str(number)
    return f"{number:.4g}".replace("inf", "∞")


def interval(low: float | None, high: float | None) -> str:
    """Two ends; a dash for none."""
    return "–" if low is None or high is None else f"{value(low)} … {value(high)}"


def with_interval(found: Spread) -> str:
    """A median with its 95 % interval, if there is one."""
    if found.ci_low is None:
        return value(found.median)
    return f"{value(found.median)} [{interval(found.ci_low, found.ci_high)}]"


def listing(items: Mapping[str, object]) -> str:
    """Names and values on one line."""
    return ", ".join(f"{name} = {item}" for name, item in items.items())


def facts_of(provenance: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What every table says of itself: command, scenario, seeds, software, commit."""
    definition = provenance.get("definition", {})
    found = {
        "command": provenance.get("command") or "not known: made from Python",
        "scenario": provenance.get("scenario", "not known"),
        "seeds": provenance.get("seeds", "not known"),
        "software": listing(provenance.get("software", {})),
        "commit": definition.get("git_commit") or "not known",
        "code": f"SHA-256 {definition.get('source_sha256', 'not known')}",
    }
    return [(name, str(text)) for name, text in found.items()]
