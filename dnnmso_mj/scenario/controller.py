"""The typed controller of a scenario: its kind, gains, network and learning rule."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from dnnmso_mj.scenario.adaptive import ConcurrentLearning, SlotineLi
from dnnmso_mj.scenario.backstepping import Backstepping
from dnnmso_mj.scenario.effectiveness import Constant, Effectiveness, Inertia
from dnnmso_mj.scenario.external import External
from dnnmso_mj.scenario.fields import NonNegative, Positive, PositiveEach, Strict, refusal
from dnnmso_mj.scenario.inversion import Inversion
from dnnmso_mj.scenario.learning import Network, Observer
from dnnmso_mj.scenario.neural import LewisNn
from dnnmso_mj.scenario.optimizers import ByMadam, Madam, Optimizer, Rule, check_resolvable, chosen
from dnnmso_mj.scenario.policy import Policy
from dnnmso_mj.scenario.replay import DnnMsoReplay
from dnnmso_mj.scenario.rivals import Rival


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


Controller = Annotated[
    DnnMso
    | NoNetwork
    | ClassicalMso
    | RbfMso
    | LewisNn
    | DnnMsoReplay
    | Backstepping
    | SlotineLi
    | ConcurrentLearning
    | Policy
    | Rival
    | External,
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
