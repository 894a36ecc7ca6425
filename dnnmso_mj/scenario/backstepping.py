"""The typed settings of the backstepping controller."""

from __future__ import annotations

from typing import Literal

from pydantic import model_validator

from dnnmso_mj.scenario.effectiveness import Effectiveness, Inertia
from dnnmso_mj.scenario.fields import Positive, PositiveEach, Strict
from dnnmso_mj.scenario.learning import KinematicNetwork, ToldObserver
from dnnmso_mj.scenario.optimizers import ByMadam, Madam, Optimizer, Rule, check_resolvable, chosen


class Backstepping(Strict):
    """The deep network's dynamics in a backstepping law of two steps, three with a drive's lag."""

    kind: Literal["backstepping"]
    """DNN-MSO with command filtered backstepping."""
    K_q: PositiveEach = (7.5,)
    """Gain of the first step, on the angle's error (1/s): one number, or one for each joint."""
    K_v: PositiveEach = (7.5,)
    """Gain of the second step, on the velocity's error (1/s): one number, or one for each joint."""
    K_tau: PositiveEach = (25.0,)
    """Gain of the third step, on the torque's error (1/s): one number, or one for each joint."""
    filter_v: Positive = 50.0
    """Bandwidth of the velocity command's filter (rad/s)."""
    filter_tau: Positive = 100.0
    """Bandwidth of the torque command's filter (rad/s)."""
    actuator_lag: Positive | None = None
    """Time constant of the drives as the controller knows it (s); null: it takes them for exact."""
    feedforward: bool = True
    """Whether K₂ e_a of the observer is added to f̂ in the law."""
    effectiveness: Effectiveness = Inertia(kind="inertia")
    """What the controller takes for B₂."""
    observer: ToldObserver = ToldObserver()
    """What the network learns against."""
    network: KinematicNetwork = KinematicNetwork()
    """The learned dynamics."""
    madam: Madam = Madam()
    """The paper's weight update."""
    optimizer: Optimizer = ByMadam(kind="madam")
    """Which rule updates the weights."""

    @model_validator(mode="after")
    def _learns(self) -> Backstepping:
        check_resolvable(self.rule, self.network.precision)
        return self

    @property
    def rule(self) -> Rule:
        """The settings of the rule that updates the weights."""
        return chosen(self.optimizer, self.madam)
