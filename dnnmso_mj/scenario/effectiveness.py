"""What a controller takes for B₂, the acceleration that a torque makes."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from dnnmso_mj.scenario.fields import Positive, Positives, Strict


class Inertia(Strict):
    """B₂ = M(q)⁻¹ of the controller's nominal model."""

    kind: Literal["inertia"]
    """B from a nominal model."""
    masses: Positives | None = None
    """Masses that the controller believes (kg); null: the plant's."""
    lengths: Positives | None = None
    """Lengths that the controller believes (m); null: the plant's."""


class Constant(Strict):
    """B₂ = b·I: no model at all."""

    kind: Literal["constant"]
    """B without a model."""
    b: Positive = 1.0
    """Control effectiveness (1/(kg·m²))."""


Effectiveness = Annotated[Inertia | Constant, Field(discriminator="kind")]
