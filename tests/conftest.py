"""Shared fixtures: the shipped arm and scenarios made of few words."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import Scenario

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="session")
def two_link() -> Mjcf:
    return Mjcf.read(ROOT / "models" / "two_link.xml")


@pytest.fixture(scope="session")
def make_scenario() -> Callable[..., Scenario]:
    """A paper scenario with some parts replaced: make_scenario({"kind": ...}, duration=1.0)."""

    def make(controller: dict[str, Any] | None = None, **parts: Any) -> Scenario:
        parts.setdefault("reference", {"kind": "sinusoid", "phase": [0.0, math.pi / 2]})
        return Scenario(name="test", controller=controller or {"kind": "dnn_mso"}, **parts)

    return make
