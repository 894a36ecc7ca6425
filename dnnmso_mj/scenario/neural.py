"""The typed settings of neural controllers that need no nominal model."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from dnnmso_mj.scenario.fields import NonNegative, Positive, PositiveEach, Strict, WeightScale


class LewisNn(Strict):
    """Lewis, Yesildirek and Liu's two-layer network, which learns the inverse dynamics."""

    kind: Literal["lewis_nn"]
    """Filtered-error control with a network tuned by augmented backpropagation."""
    hidden: Annotated[int, Field(ge=1, le=4096)] = 10
    """Number of sigmoidal hidden units."""
    lam: Positive = 5.0
    """λ of the filtered error r = ė + λ e (1/s)."""
    K_v: PositiveEach = (20.0,)
    """Feedback on r (N·m·s/rad): one number, or one for each joint."""
    F: Positive = 100.0
    """Learning rate of the output weights."""
    G: Positive = 10.0
    """Learning rate of the hidden weights."""
    kappa: NonNegative = 0.01
    """κ, the forgetting in proportion to the error that keeps the weights bounded."""
    K_Z: NonNegative = 0.05
    """Gain of the robustifying term (N·m·s/rad)."""
    Z_B: NonNegative = 100.0
    """What the norm of the ideal weights is taken to be at most."""
    init_scale: WeightScale = 1.0
    """Spread of the first hidden weights, times √(number of inputs); output weights start at 0."""
