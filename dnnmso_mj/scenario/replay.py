"""The DNN-MSO with memory: what it remembers, at which rates it learns, and what it knows."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from dnnmso_mj.scenario.fields import NonNegative, Positive, PositiveEach, Strict, WeightScale
from dnnmso_mj.scenario.inversion import Inversion
from dnnmso_mj.scenario.learning import HiddenWidths, Network
from dnnmso_mj.scenario.optimizers import Madam, check_resolvable

LearningRate = Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)]
Delay = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


class ModelNetwork(Strict):
    """The deep network of the n accelerations; the velocities are measured, not learned."""

    hidden: HiddenWidths = (64, 64, 64)
    """Width of each hidden layer."""
    activation: Literal["sigmoid", "tanh", "relu"] = "sigmoid"
    """Activation of the hidden layers; the output layer is linear."""
    bias: bool = True
    """Whether each layer sees a constant 1 beside its inputs."""
    init_scale: WeightScale | None = None
    """Kumar's constant: spread = init_scale/√fan_in. null: the activation's own (sigmoid 3.6)."""
    first_output: WeightScale = 0.1
    """Factor on the initial weights of the output layer: a small one keeps the first torque low."""
    precision: Literal["float64", "float32"] = "float32"
    """Arithmetic of the network."""

    def as_network(self) -> Network:
        """The same as the network of the paper's controller."""
        same = {name: getattr(self, name) for name in Network.model_fields if hasattr(self, name)}
        return Network(outputs="kinematic", output_scale=self.first_output, **same)


class Replay(Strict):
    """What is remembered, and how often it is learned from."""

    samples: Annotated[int, Field(ge=0, le=64)] = 8
    """Remembered states learned from in each tick; 0: none."""
    capacity: Annotated[int, Field(ge=1, le=100_000)] = 2000
    """How many states are remembered."""
    spacing: Positive = 0.02
    """Side of the cells of the state space (rad, rad/s) that keep one state each."""
    position_spread: NonNegative = 0.002
    """Largest displacement of a replayed joint angle (rad)."""
    velocity_spread: NonNegative = 0.05
    """Largest displacement of a replayed joint velocity (rad/s)."""
    every: Positive = 0.005
    """Time between two states that are remembered (s)."""
    eta: LearningRate = 0.0003
    """Largest learning rate of remembered states."""
    error: Positive = 0.2
    """Their RMS error (rad/s²) from which on the rate is the largest; it falls with its square."""


class Rate(Strict):
    """η = eta_min + (madam.eta - eta_min) min(1, ‖ē‖/error): it follows the observer's error."""

    eta_min: LearningRate = 1e-5
    """Learning rate of a model without error."""
    error: Positive = 0.5
    """‖ē‖ (rad/s²) from which on the learning rate is madam.eta."""
    low_pass: Positive = 0.05
    """Time constant of ē, the low-passed K₂ e_a (s)."""
    average: Positive = 0.08
    """Time over which weights are averaged for use (s)."""


class KnownDelay(Strict):
    """What the controller knows of delays, and predicts over."""

    sensor: Delay = 0.0
    """Age of a measurement (s)."""
    actuator: Delay = 0.0
    """Time until a command acts (s)."""


class DnnMsoReplay(Strict):
    """The paper's controller with memory and feed-forward; its errors set its learning rates."""

    kind: Literal["dnn_mso_replay"]
    """DNN-MSO with experience replay."""
    inversion: Inversion = Inversion()
    """From the desired dynamics to a torque."""
    K2: PositiveEach = (70.0,)
    """Observer gain (1/s): one number, or one for each of the 2n states."""
    network: ModelNetwork = ModelNetwork()
    """The learned dynamics."""
    madam: Madam = Madam()
    """The weight update."""
    replay: Replay = Replay()
    """The memory."""
    rate: Rate = Rate()
    """The learning rate."""
    feed_forward: Literal[0, 1, 2] = 2
    """Order of the feed-forward of the observer's error: 1 adds K₂ e_a to f̂, 2 without its lag."""
    known_delay: KnownDelay = KnownDelay()
    """What is known of delays."""

    @model_validator(mode="after")
    def _learns(self) -> DnnMsoReplay:
        check_resolvable(self.madam, self.network.precision)
        return self

    @property
    def rule(self) -> Madam:
        """The settings of the rule that updates the weights."""
        return self.madam

    @property
    def lookahead(self) -> float:
        """How far ahead of its tick the reference is read (s)."""
        return self.known_delay.actuator
