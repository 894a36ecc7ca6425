"""The typed controller of a scenario: its kind, gains, network and learning rule."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from dnnmso_mj.scenario.fields import (
    Matrix,
    NonNegative,
    Positive,
    PositiveEach,
    Positives,
    Strict,
    WeightScale,
    as_tuple,
    refusal,
)
from dnnmso_mj.scenario.neural import LewisNn
from dnnmso_mj.scenario.optimizers import ByMadam, Madam, Optimizer, Rule, check_resolvable, chosen

MAX_WEIGHTS = 10_000_000


class Network(Strict):
    """The deep network f̂ and its initial weights."""

    hidden: Annotated[
        tuple[Annotated[int, Field(ge=1, le=4096)], ...],
        Field(min_length=1, max_length=32),
        BeforeValidator(as_tuple),
    ] = (64, 64, 64)
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


class Inversion(Strict):
    """Dynamic inversion with slack augmentation, Eq. 10 and after."""

    K: PositiveEach = (7.5,)
    """Tracking gain (1/s): one number, or one for each of the 2n states."""
    lam: NonNegative = 7.5
    """λ of the slack matrix B_s = [I; -λI] (1/s). The paper leaves B_s open."""
    slack_matrix: Matrix | None = None
    """A general slack matrix B_s, 2n rows of n; it replaces lam."""
    effectiveness: Effectiveness = Inertia(kind="inertia")
    """What the controller takes for B."""

    @model_validator(mode="after")
    def _invertible(self) -> Inversion:
        if self.slack_matrix is None:
            return self
        rows, widths = len(self.slack_matrix), {len(row) for row in self.slack_matrix}
        if widths != {rows // 2} or rows % 2:
            problem = "has rows that do not fit; allowed: 2n rows of n numbers each"
            raise refusal(("slack_matrix", problem))
        upper = np.array(self.slack_matrix[: rows // 2])
        if np.linalg.matrix_rank(upper) < rows // 2:
            problem = "leaves [B B_s] without an inverse; allowed: regular upper n rows"
            raise refusal(("slack_matrix", problem))
        return self


class DnnMso(Strict):
    """The paper's controller: the network learns all the dynamics."""

    kind: Literal["dnn_mso"]
    """DNN-MSO."""
    inversion: Inversion = Inversion()
    """From the desired dynamics to a torque."""
    observer: Observer = Observer()
    """What the network learns against."""
    network: Network = Network()
    """The learned dynamics."""
    madam: Madam = Madam()
    """The paper's weight update."""
    optimizer: Optimizer = ByMadam(kind="madam")
    """Which rule updates the weights."""

    @model_validator(mode="after")
    def _learns(self) -> DnnMso:
        check_resolvable(self.rule, self.network.precision)
        return self

    @property
    def rule(self) -> Rule:
        """The settings of the rule that updates the weights."""
        return chosen(self.optimizer, self.madam)


class NoNetwork(Strict):
    """The paper's controller with the network off: inversion and feedback alone."""

    kind: Literal["no_network"]
    """Dynamic inversion without learning."""
    inversion: Inversion = Inversion()
    """From the desired dynamics to a torque."""
    observer: Observer = Observer()
    """What the network learns against."""
    kinematics: bool = True
    """Whether q̇ stands in the upper rows of f̂; false leaves all of f̂ at zero."""


class ClassicalMso(Strict):
    """Eq. 4: known dynamics of the nominal model plus a learned uncertainty d̂."""

    kind: Literal["classical_mso"]
    """The modified state observer with known dynamics."""
    inversion: Inversion = Inversion()
    """From the desired dynamics to a torque."""
    observer: Observer = Observer()
    """What the network learns against."""
    network: Network = Network()
    """The learned dynamics."""
    madam: Madam = Madam()
    """The paper's weight update."""
    optimizer: Optimizer = ByMadam(kind="madam")
    """Which rule updates the weights."""

    @model_validator(mode="after")
    def _needs_a_model(self) -> ClassicalMso:
        _refuse_no_model(self.kind, self.inversion)
        if self.network.outputs != "full":
            problem = "has no meaning for classical_mso, which learns a torque; allowed: full"
            raise refusal(("network.outputs", problem))
        check_resolvable(self.rule, self.network.precision)
        return self

    @property
    def rule(self) -> Rule:
        """The settings of the rule that updates the weights."""
        return chosen(self.optimizer, self.madam)


class RbfMso(Strict):
    """Eq. 4 with radial basis functions for d̂, tuned by a gradient law."""

    kind: Literal["rbf_mso"]
    """The modified state observer with known dynamics and Gaussian features."""
    inversion: Inversion = Inversion()
    """From the desired dynamics to a torque."""
    observer: Observer = Observer()
    """What the weights are tuned against."""
    centres: Annotated[int, Field(ge=1, le=100_000)] = 100
    """Number of Gaussians, their centres drawn over the box."""
    box: PositiveEach = (1.5,)
    """Half-width of the box of states about zero (rad, rad/s): one number, or one for each."""
    width: Positive = 0.7
    """Standard deviation of each Gaussian, in half-widths of the box."""
    Gamma: Positive = 300.0
    """Adaptation gain Γ."""
    kappa: NonNegative = 0.001
    """κ of the e-modification, which keeps the weights bounded."""

    @model_validator(mode="after")
    def _needs_a_model(self) -> RbfMso:
        _refuse_no_model(self.kind, self.inversion)
        return self


def _refuse_no_model(kind: str, inversion: Inversion) -> None:
    if isinstance(inversion.effectiveness, Constant):
        problem = f"leaves {kind} without a model of the plant; allowed: inertia"
        raise refusal(("inversion.effectiveness.kind", problem))


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
    """The paper's controller with memory, feed-forward and a learning rate that follows its error."""

    kind: Literal["dnn_mso_replay"]
    """DNN-MSO with experience replay."""
    inversion: Inversion = Inversion()
    """From the desired dynamics to a torque."""
    observer: Observer = Observer(torque="applied")
    """What the network learns against."""
    network: Network = Network(outputs="kinematic", output_scale=0.1)
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
    def lookahead(self) -> float:
        """How far ahead of its tick the reference is read (s)."""
        return self.known_delay.actuator


Controller = Annotated[
    DnnMso | NoNetwork | ClassicalMso | DnnMsoReplay | RbfMso | LewisNn,
    Field(discriminator="kind"),
]


def inversion(controller: Controller) -> Inversion | None:
    """The dynamic inversion of a controller, if that is its law."""
    part: Inversion | None = getattr(controller, "inversion", None)
    return part


def effectiveness(controller: Controller) -> Effectiveness:
    """What a controller takes for B₂; of one that does not say, the plant's own M(q)⁻¹."""
    part: Effectiveness = getattr(
        inversion(controller) or controller, "effectiveness", Inertia(kind="inertia")
    )
    return part


def lookahead(controller: Controller) -> float:
    """How far ahead of its tick (s) a controller reads the reference: the delay it knows of."""
    return float(getattr(controller, "lookahead", 0.0))
