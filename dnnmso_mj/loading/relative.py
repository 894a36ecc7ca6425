"""Files that a controller names, made absolute from the folder of the file that names them."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from dnnmso_mj.loading.overrides import Override
from dnnmso_mj.loading.shape import lookup
from dnnmso_mj.policies import digest

CONTROLLER = ("controller",)


def absolute(controller: Any, folder: Path) -> Any:
    """A controller with `file` and the file of `python` taken from `folder`; others as they are."""
    if not isinstance(controller, dict):
        return controller
    found = {key: controller[key] for key in ("file", "python") if key in controller}
    return controller | {key: _absolute(key, value, folder) for key, value in found.items()}


def absolute_set(item: Override) -> Override:
    """The same of what a `--set` puts into the controller; from the current folder."""
    if item.path == CONTROLLER:
        return replace(item, value=absolute(item.value, Path.cwd()))
    if len(item.path) == 2 and item.path[:1] == CONTROLLER:
        key = item.path[1]
        return replace(item, value=absolute({key: item.value}, Path.cwd())[key])
    return item


def pin_policy(data: Any) -> None:
    """Write the SHA-256 of a policy's file beside it, where there is none."""
    controller = lookup(data, CONTROLLER)
    if not isinstance(controller, dict) or controller.get("kind") != "policy":
        return
    file = controller.get("file")
    if isinstance(file, str) and controller.get("sha256") is None:
        with suppress(OSError, ValueError):  # no such file: told when it is opened
            controller["sha256"] = digest(Path(file))


def _absolute(key: str, value: Any, folder: Path) -> Any:
    if not isinstance(value, str) or not value:
        return value
    if key == "file":
        return os.path.abspath(folder / value)
    where, _, name = value.rpartition(":")
    return f"{os.path.abspath(folder / where)}:{name}" if where.endswith(".py") else value
