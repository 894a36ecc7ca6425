"""What learns, and against what: the network and the observer of a controller."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from dnnmso_mj.scenario.fields import PositiveEach, Strict, WeightScale, as_tuple, refusal

MAX_WEIGHTS = 10_000_000

HiddenWidths = Annotated[
    tuple[Annotated[int, Field(ge=1, le=4096)], ...],
    Field(min_length=1, max_length=32),
    BeforeValidator(as_tuple),
]


class Network(Strict):
    """The deep network f̂ and its initial weights."""

    hidden: HiddenWidths = (64, 64, 64)
    """Width of each hidden layer; three hidden layers make the paper's four weight layers."""
    activation: Literal["sigmoid", "tanh", "relu"] = "sigmoid"
    """Activation of the hidden layers; the output layer is linear."""
    outputs: Literal["full", "kinematic"] = "full"
    """full: all 2n rows are learned (paper). kinematic: the upper n rows are the measured q̇."""
    bias: bool = True
    """Whether each layer sees a constant 1 beside its inputs."""
    init_scale: WeightScale | None = None
    """Kumar's constant: spread = init_scale/√fan_in. null: the activation's own (sigmoid 3.6)."""
    init_spread: Literal["standard_deviation", "variance"] = "standard_deviation"
    """Whether init_scale/√fan_in is a standard deviation or a variance; the paper does not say."""
    output_scale: WeightScale = 1.0
    """Factor on the initial weights of the output layer."""
    backend: Literal["kernel", "torch"] = "kernel"
    """kernel: compiled (fast). torch: the reference that the kernel is tested against (slow)."""
    precision: Literal["float64", "float32"] = "float32"
    """Arithmetic of the network: float32, torch's own default, takes half the time of float64."""

    @model_validator(mode="after")
    def _fits_in_memory(self) -> Network:
        weights = sum(a * b for a, b in zip(self.hidden, self.hidden[1:], strict=False))
        if weights > MAX_WEIGHTS:
            allowed = f"allowed: at most {MAX_WEIGHTS} between hidden layers"
            raise refusal(("hidden", f"makes {weights} weights; {allowed}"))
        return self


class Observer(Strict):
    """The state observer of Eq. 5."""

    K2: PositiveEach = (30.0,)
    """Observer gain (1/s): one number, or one for each of the 2n states."""
    feedback: Literal["stable", "as_printed"] = "stable"
    """stable: +K₂(X - X̂). as_printed: the paper's sign, which diverges."""
    torque: Literal["commanded", "applied"] = "commanded"
    """The torque that it takes for u: its own command (paper), or what the drives say acted."""


class ToldObserver(Observer):
    """The state observer of Eq. 5, told by default which torque acted."""

    torque: Literal["commanded", "applied"] = "applied"
    """The torque that it takes for u: what the drives say acted, or its own command."""


class KinematicNetwork(Network):
    """The deep network of the dynamics, by default of the accelerations alone, and small at first.

    Both make the torque smoother and its first peak lower.
    """

    outputs: Literal["full", "kinematic"] = "kinematic"
    """full: the upper n rows of f̂ are q̇ and what is learned beside it. kinematic: q̇ alone."""
    output_scale: WeightScale = 0.1
    """Factor on the initial weights of the output layer."""
