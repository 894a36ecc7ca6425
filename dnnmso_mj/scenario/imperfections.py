"""What separates the simulation from a robot: its drives, its sensors and the friction in it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from dnnmso_mj.scenario.external import ExternalImperfection
from dnnmso_mj.scenario.fields import (
    CountEach,
    DampingEach,
    FiniteEach,
    NonNegativeEach,
    PositiveEach,
    Strict,
    as_tuple,
    expand,
    refusal,
)

Delay = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


class Friction(Strict):
    """-(viscous q̇ + [coulomb + (breakaway - coulomb) exp(-(q̇/stribeck_velocity)²)] sign q̇)."""

    viscous: DampingEach = (0.0,)
    """Friction that grows with velocity (N·m·s/rad)."""
    coulomb: NonNegativeEach = (0.0,)
    """Dry friction of a joint that moves (N·m)."""
    breakaway: NonNegativeEach | None = None
    """Dry friction that holds a joint at rest (N·m), coulomb or more; null: as much as coulomb."""
    stribeck_velocity: PositiveEach = (0.01,)
    """Velocity at which breakaway has given way to coulomb, to 1/e of their difference (rad/s)."""

    @model_validator(mode="after")
    def _holds_more_than_it_slows(self) -> Friction:
        if self.breakaway is None:
            return self
        size = max(len(self.breakaway), len(self.coulomb))
        if {len(self.breakaway), len(self.coulomb)} <= {1, size}:
            pairs = zip(expand(self.breakaway, size), expand(self.coulomb, size), strict=True)
            if any(holds < slows for holds, slows in pairs):
                most = ", ".join(f"{value:g}" for value in self.coulomb)
                raise refusal(("breakaway", f"is below coulomb; allowed: {most} or more"))
        return self

    @property
    def is_dry(self) -> bool:
        """Whether any joint has friction that is there at rest too."""
        return any(self.coulomb) or any(self.breakaway or ())


class Imperfections(Strict):
    """What separates the simulation from a robot; all off unless given."""

    torque_limit: PositiveEach | None = None
    """Largest |torque| of each joint's actuator (N·m); null: none."""
    torque_rate: PositiveEach | None = None
    """Fastest change of each actuator's torque (N·m/s), from none at the start; null: any."""
    actuator_lag: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = 0.0
    """Time constant with which the torque follows (s)."""
    actuator_delay: Delay = 0.0
    """From a command to its torque (s), at most 1; fractions of a step too."""
    sensor_delay: Delay = 0.0
    """Age of every reading (s), at most 1; fractions of a step too."""
    jitter: Delay = 0.0
    """Each reading is older by up to this (s), at most 1; uniform."""
    position_noise: NonNegativeEach = (0.0,)
    """White noise on each angle read, its standard deviation (rad)."""
    velocity_noise: NonNegativeEach = (0.0,)
    """White noise on each velocity read, its standard deviation (rad/s)."""
    position_bias: FiniteEach = (0.0,)
    """Constant error of each angle read (rad)."""
    velocity_bias: FiniteEach = (0.0,)
    """Constant error of each velocity read (rad/s)."""
    position_drift: NonNegativeEach = (0.0,)
    """Random walk of the error of each angle read, its standard deviation after 1 s (rad/√s)."""
    velocity_drift: NonNegativeEach = (0.0,)
    """The same of each velocity read (rad/s/√s)."""
    encoder_counts: CountEach | None = None
    """Steps of each joint's encoder a revolution; null: no steps."""
    velocity_from: Literal["sensor", "difference"] = "sensor"
    """Velocity read by a sensor of its own, or as the difference of the angles read."""
    velocity_filter: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = 0.0
    """Time constant of the low-pass filter of that difference (s)."""
    friction: Friction = Friction()
    """Friction in the joints."""
    external: Annotated[tuple[ExternalImperfection, ...], BeforeValidator(as_tuple)] = ()
    """Imperfections of your own; see docs/extending.md."""

    @model_validator(mode="after")
    def _one_velocity(self) -> Imperfections:
        """Refuse what would have no effect."""
        if self.velocity_from == "sensor":
            if self.velocity_filter > 0.0:
                problem = "filters the difference of angles; allowed: 0 unless velocity_from is"
                raise refusal(("velocity_filter", f"{problem} difference"))
            return self
        own = ("velocity_noise", "velocity_bias", "velocity_drift")
        idle = [name for name in own if any(getattr(self, name))]
        problem = "is of a velocity sensor; allowed: 0 where velocity_from is difference"
        if idle:
            raise refusal(*((name, problem) for name in idle))
        return self
