"""Limits of the joints, whose passing stops the arm."""

from __future__ import annotations

from typing import Literal

from pydantic import model_validator

from dnnmso_mj.scenario.fields import (
    FiniteEach,
    NonNegativeEach,
    Positive,
    PositiveEach,
    Strict,
    expand,
    refusal,
)


class Safety(Strict):
    """Limits of the true state; the first tick past one begins a safe stop, which ends the run."""

    q_min: FiniteEach | None = None
    """Smallest angle of each joint (rad); null: none."""
    q_max: FiniteEach | None = None
    """Largest angle of each joint (rad); null: none."""
    qd_max: PositiveEach | None = None
    """Largest |velocity| of each joint (rad/s); null: none."""
    response: Literal["brake", "zero"] = "brake"
    """Torque of the stop: -stiffness (q - q at its first tick) - damping q̇, or none."""
    stiffness: NonNegativeEach = (500.0,)
    """Of the brake (N·m/rad)."""
    damping: NonNegativeEach = (100.0,)
    """Of the brake (N·m·s/rad)."""
    standstill: Positive = 0.01
    """The arm stands once no joint has been faster than this for 0.1 s (rad/s)."""
    stop_time: Positive = 2.0
    """The run ends after this, though the arm does not stand (s)."""

    @model_validator(mode="after")
    def _leaves_room(self) -> Safety:
        if self.q_min is None or self.q_max is None:
            return self
        size = max(len(self.q_min), len(self.q_max))
        if {len(self.q_min), len(self.q_max)} <= {1, size}:
            pairs = zip(expand(self.q_min, size), expand(self.q_max, size), strict=True)
            if any(low >= high for low, high in pairs):
                least = ", ".join(f"{value:g}" for value in self.q_min)
                raise refusal(("q_max", f"is not above q_min; allowed: more than {least}"))
        return self

    @property
    def guards(self) -> bool:
        """Whether there is any limit."""
        return not (self.q_min is None and self.q_max is None and self.qd_max is None)
