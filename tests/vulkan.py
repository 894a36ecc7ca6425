"""Whether this machine can draw the viewer without a display."""

from __future__ import annotations

import ctypes.util
from pathlib import Path

import pytest

DRIVERS = [Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d")]
HAS_VULKAN = ctypes.util.find_library("vulkan") is not None and any(
    folder.is_dir() and any(folder.iterdir()) for folder in DRIVERS
)
needs_vulkan = pytest.mark.skipif(
    not HAS_VULKAN, reason="no Vulkan driver: apt-get install mesa-vulkan-drivers libvulkan1"
)
