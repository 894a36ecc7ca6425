"""What happens to a run at a set time."""

from __future__ import annotations

from typing import Literal

from dnnmso_mj.scenario.fields import NonNegative, Strict


class Freeze(Strict):
    """The controller stops learning."""

    kind: Literal["freeze"]
    """An end of learning."""
    at: NonNegative
    """When (s)."""
    what: Literal["model", "all"] = "model"
    """model: weights and adapted parameters. all: its estimate of the disturbance goes as well."""


Event = Freeze
