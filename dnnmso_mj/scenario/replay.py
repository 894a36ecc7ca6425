"""The DNN-MSO with memory: what it remembers, at which rates it learns, and what it knows."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from dnnmso_mj.scenario.fields import NonNegative, Positive, Strict
from dnnmso_mj.scenario.inversion import Inversion
from dnnmso_mj.scenario.learning import KinematicNetwork, ToldObserver
from dnnmso_mj.scenario.optimizers import Madam


class Replay(Strict):
    """What is remembered, and how often it is learned from."""

    samples: Annotated[int, Field(ge=0, le=64)] = 8
    """Remembered states learned from in each tick; 0: none."""
    capacity: Annotated[int, Field(ge=1, le=100_000)] = 2000
    """How many states are remembered."""
    spacing: Positive = 0.02
    """Side of the cells of the state space (rad, rad/s) that keep one state each."""
    position_spread: NonNegative = 0.004
    """Largest displacement of a replayed joint angle (rad)."""
    velocity_spread: NonNegative = 0.05
    """Largest displacement of a replayed joint velocity (rad/s)."""
    every: Positive = 0.005
    """Time between two states that are remembered (s)."""
    eta: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] = 0.001
    """Largest learning rate of remembered states."""
    error: Positive = 1.0
    """Their RMS error (rad/s²) from which on the rate is the largest; it falls with its square."""


class Rate(Strict):
    """η = eta_min + (madam.eta - eta_min) min(1, ‖ē‖/error): it follows the observer's error."""

    eta_min: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] = 1e-5
    """Learning rate of a model without error."""
    error: Positive = 0.3
    """‖ē‖ (rad/s²) from which on the learning rate is madam.eta."""
    low_pass: Positive = 0.05
    """Time constant of ē, the low-passed K₂ e_a (s)."""
    average: Positive = 0.1
    """Time over which weights are averaged for use (s)."""


Delay = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


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
    observer: ToldObserver = ToldObserver()
    """What the network learns against."""
    network: KinematicNetwork = KinematicNetwork()
    """The learned dynamics."""
    madam: Madam = Madam()
    """The weight update."""
    replay: Replay = Replay()
    """The memory."""
    rate: Rate = Rate()
    """The learning rate."""
    feed_forward: Literal[0, 1, 2] = 2
    """Whether the observer's K₂ e_a is added to f̂ in the inversion."""
    known_delay: KnownDelay = KnownDelay()
    """What is known of delays."""

    @property
    def rule(self) -> Madam:
        """The settings of the rule that updates the weights."""
        return self.madam

    @property
    def lookahead(self) -> float:
        """How far ahead of its tick the reference is read (s)."""
        return self.known_delay.actuator
