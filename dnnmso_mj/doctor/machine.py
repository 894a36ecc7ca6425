"""The machine: where compiled code is kept, what can draw, how well the wall clock can be kept."""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from dnnmso_mj.doctor import Finding

LOW_DISK = 1e9  # bytes; a run of 10 s takes about 5 MB
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
VULKAN_FIX = "apt-get install mesa-vulkan-drivers libvulkan1"


def machine() -> Iterator[Finding]:
    """Caches, displays, priorities, cores and disk."""
    yield _cache()
    yield _display()
    yield _vulkan()
    yield _browser()
    yield _priority()
    yield _cores()
    yield _disk()


def _cache() -> Finding:
    """Where numba will keep compiled code: the first of the places it tries that can be written."""
    package = Path(__file__).resolve().parents[1]
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "numba"
    places = [Path(chosen)] if chosen else [package / "__pycache__", home]
    for place in places:
        if _can_write(place):
            return Finding("machine", "compiled code", "ok", f"is kept in {place}")
    tried = " or ".join(map(str, places))
    fix = "set the environment variable NUMBA_CACHE_DIR to a folder that can be written"
    return Finding("machine", "compiled code", "broken", f"{tried} cannot be written", fix)


def _can_write(folder: Path) -> bool:
    """Whether a file can be made in a folder, or where it would be made."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    try:
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _display() -> Finding:
    name = "display"
    shown = os.environ.get("WAYLAND_DISPLAY") or os.environ.get("DISPLAY")
    if sys.platform != "linux" or shown:
        return Finding("machine", name, "ok", shown or sys.platform)
    fix = "dnnmso replay LOG with --serve (a browser), --screenshot FILE.png or --save FILE.rrd"
    return Finding("machine", name, "missing", "none, so the viewer has no window", fix)


def _vulkan() -> Finding:
    """Screenshots are drawn without a window, by a Vulkan driver."""
    name = "Vulkan"
    if sys.platform != "linux":
        return Finding("machine", name, "ok", f"comes with {platform.system()}")
    library = ctypes.util.find_library("vulkan")
    if library is None:
        return Finding("machine", name, "missing", "no libvulkan: no screenshots", VULKAN_FIX)
    try:
        ctypes.CDLL(library)
    except OSError as error:
        return Finding("machine", name, "missing", f"{library}: {error}", VULKAN_FIX)
    drivers = sorted(_vulkan_drivers())
    if not drivers:
        return Finding("machine", name, "missing", "no driver: no screenshots", VULKAN_FIX)
    return Finding("machine", name, "ok", f"{library}, {len(drivers)} drivers")


def _vulkan_drivers() -> Iterator[Path]:
    named = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES")
    if named:
        yield from (Path(file) for file in named.split(os.pathsep) if Path(file).is_file())
        return
    data = os.environ.get("XDG_DATA_DIRS") or "/usr/local/share:/usr/share"
    folders = ["/etc", *data.split(os.pathsep), str(Path.home() / ".local" / "share")]
    for folder in folders:
        yield from (Path(folder) / "vulkan" / "icd.d").glob("*.json")


def _browser() -> Finding:
    found = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if found:
        return Finding("machine", "browser", "ok", found)
    detail = "no Chromium; only the tests of the documentation need it"
    return Finding("machine", "browser", "missing", detail, "apt-get install chromium")


def _priority() -> Finding:
    """Whether `--real-time` may run before other processes, tried and undone."""
    name = "real-time priority"
    if not hasattr(os, "sched_setscheduler"):
        return Finding("machine", name, "note", f"none on {platform.system()}")
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except OSError:
        fix = "a line `@USER - rtprio 50` in /etc/security/limits.conf, or run as root"
        return Finding("machine", name, "note", "no right to it: --real-time may wake late", fix)
    os.sched_setscheduler(0, policy, parameters)
    return Finding("machine", name, "ok", "SCHED_FIFO is granted")


def _cores() -> Finding:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    if cores == 1:
        return Finding("machine", "cores", "note", "1: runs of a sweep go one after the other")
    return Finding("machine", "cores", "ok", f"{cores}, so many runs of a sweep at once")


def _disk() -> Finding:
    """Room for logs, below the folder that this was called in."""
    folder = Path.cwd() / "logs"
    where = folder if folder.is_dir() else Path.cwd()
    if not _can_write(where):
        fix = "go to another folder, or name a log with --out"
        return Finding("machine", "logs", "note", f"{where} cannot be written", fix)
    free = shutil.disk_usage(where).free
    detail = f"{free / 1e9:.1f} GB free in {where}"
    if free < LOW_DISK:
        return Finding("machine", "logs", "note", detail, "make room; 10 s of a run take 5 MB")
    return Finding("machine", "logs", "ok", detail)
