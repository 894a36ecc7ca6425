"""The typed settings of controllers that adapt the parameters of a regressor."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from dnnmso_mj.scenario.fields import (
    Finite,
    NonNegative,
    Positive,
    PositiveEach,
    Strict,
    as_tuple,
    refusal,
)

N_PARAMETERS = 7
Parameters = Annotated[
    tuple[Finite, ...],
    Field(min_length=N_PARAMETERS, max_length=N_PARAMETERS),
    BeforeValidator(as_tuple),
]


class _Adaptive(Strict):
    """What both share."""

    lam: Positive = 4.0
    """λ of s = ė + λ e (1/s)."""
    K_D: PositiveEach = (60.0, 25.0)
    """Feedback on s (N·m·s/rad): one number, or one for each joint."""
    Gamma: PositiveEach = (2.0, 2.0, 2.0, 150.0, 150.0, 0.5, 0.5)
    """Adaptation gain Γ: one number, or one for each of p1, p2, p3, g1, g2, f1, f2."""
    sigma: NonNegative = 0.0
    """Leakage of the estimates, relative to Γ; holds them where noise would make them drift."""
    theta: Parameters | None = None
    """First estimates of p1, p2, p3 (kg·m²), g1, g2 (N·m), f1, f2 (N·m·s/rad); null: all zero."""

    @model_validator(mode="after")
    def _sizes(self) -> _Adaptive:
        for name, most in (("K_D", 2), ("Gamma", N_PARAMETERS)):
            found = len(getattr(self, name))
            if found not in (1, most):
                raise refusal((name, f"has {found} entries; allowed: 1 or {most}"))
        return self


class SlotineLi(_Adaptive):
    """Slotine and Li's adaptive controller: the form of the robot known, its numbers not."""

    kind: Literal["slotine_li"]
    """Passivity-based adaptive control with a regressor."""


class ConcurrentLearning(_Adaptive):
    """Slotine and Li's, and learning from recorded motion at the same time."""

    kind: Literal["concurrent_learning"]
    """Adaptive control with integral concurrent learning."""
    k_CL: Positive = 30.0
    """Gain of what is learned from the record."""
    window: Positive = 0.1
    """Over how long each recorded pair is integrated (s)."""
    stack: Annotated[int, Field(ge=4, le=200)] = 20
    """How many pairs are kept."""
    max_age: Positive | None = None
    """After how long a pair makes way for any other (s); null: never, as published."""
