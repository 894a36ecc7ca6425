"""What a benchmark was run on: without it a number says nothing."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from dnnmso_mj.provenance import software_versions

_COMPETITORS = ("torch", "dm-control", "gymnasium", "mcap", "mcap-protobuf-support")


def machine() -> dict[str, object]:
    """CPU, cores, memory and system of this machine."""
    return {
        "cpu": _cpu(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None,
        "ram_gib": _ram_gib(),
        "os": platform.platform(),
    }


def versions() -> dict[str, str]:
    """Versions of this package, of what it rests on and of those it is compared with."""
    found = software_versions()
    for name in _COMPETITORS:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def load_average() -> list[float] | None:
    """Processes that wanted to run, mean of 1, 5 and 15 minutes; None where unknown."""
    return [round(load, 2) for load in os.getloadavg()] if hasattr(os, "getloadavg") else None


def _cpu() -> str:
    """The model as Linux tells it, since `platform` only knows the architecture there."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    pairs = (line.partition(":") for line in reversed(lines))
    facts = {key.strip(): value.strip() for key, _, value in pairs}
    name = facts.get("model name", platform.machine())
    detail = ", ".join(f"{key} {facts[key]}" for key in ("cpu family", "model") if key in facts)
    return f"{name} ({detail})" if detail else name


def _ram_gib() -> float | None:
    if not hasattr(os, "sysconf"):
        return None
    return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
