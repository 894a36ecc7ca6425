"""What happens to a run at a set time."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from dnnmso_mj.scenario.fields import (
    Finite,
    FiniteEach,
    NonNegative,
    Positive,
    Strict,
    as_tuple,
    refusal,
)

Force = Annotated[tuple[Finite, ...], Field(min_length=2, max_length=3), BeforeValidator(as_tuple)]


class Payload(Strict):
    """A point mass is fixed at the tip of the last link, from then on."""

    kind: Literal["payload"]
    """Something is taken up, or dropped."""
    at: NonNegative
    """When (s); at the nearest tick."""
    mass: Finite
    """How much (kg); negative: dropped."""

    @model_validator(mode="after")
    def _weighs_something(self) -> Payload:
        if self.mass == 0.0:
            raise refusal(("mass", "changes nothing; allowed: any other number"))
        return self


class Push(Strict):
    """Something outside pushes the joints, the tip, or both."""

    kind: Literal["push"]
    """A torque or force from outside, for a while."""
    at: NonNegative
    """When it begins (s); at the nearest tick."""
    duration: Positive
    """How long it lasts (s); to the nearest tick."""
    torque: FiniteEach | None = None
    """On each joint (N·m)."""
    force: Force | None = None
    """On the tip of the last link (N), [x, z] or [x, y, z] in the world's frame."""

    @model_validator(mode="after")
    def _pushes_something(self) -> Push:
        if not any(self.torque or ()) and not any(self.force or ()):
            raise refusal(("torque", "is zero or not given, and so is force; allowed: one of them"))
        return self


class Freeze(Strict):
    """The controller stops learning."""

    kind: Literal["freeze"]
    """An end of learning."""
    at: NonNegative
    """When (s)."""
    what: Literal["model", "all"] = "model"
    """model: weights and adapted parameters. all: its estimate of the disturbance goes as well."""


Event = Annotated[Payload | Push | Freeze, Field(discriminator="kind")]
