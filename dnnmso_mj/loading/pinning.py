"""Which policy a scenario means: the SHA-256 of its file."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from dnnmso_mj.files import digest
from dnnmso_mj.loading.shape import lookup


def pin_policy(data: Any) -> None:
    """Write the SHA-256 of a policy's file beside it, where there is none."""
    controller = lookup(data, ("controller",))
    if not isinstance(controller, dict) or controller.get("kind") != "policy":
        return
    file = controller.get("file")
    if isinstance(file, str) and controller.get("sha256") is None:
        with suppress(OSError, ValueError):  # no such file: told when it is opened
            if Path(file).is_file():  # of a device or a FIFO there is no end
                controller["sha256"] = digest(Path(file))
