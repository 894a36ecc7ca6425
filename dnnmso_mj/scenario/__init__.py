"""The typed scenario: everything that decides a run, with units, ranges and the paper's values.

Here are the shapes, and the rules within one of them; those that tie one to another are in
`dnnmso_mj.consistency`. Loading a file with line numbers and messages for people is
`dnnmso_mj.loading`'s work.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from dnnmso_mj.consistency import contradictions, entries
from dnnmso_mj.scenario.adaptive import ConcurrentLearning, SlotineLi
from dnnmso_mj.scenario.backstepping import Backstepping
from dnnmso_mj.scenario.controller import ClassicalMso, Controller, DnnMso, NoNetwork, RbfMso
from dnnmso_mj.scenario.effectiveness import Constant, Effectiveness, Inertia
from dnnmso_mj.scenario.events import Event, Freeze, Payload, Push
from dnnmso_mj.scenario.external import (
    External,
    ExternalImperfection,
    ExternalReference,
)
from dnnmso_mj.scenario.fields import (
    FiniteEach,
    NonNegative,
    Positive,
    Positives,
    Strict,
    Vector,
    as_tuple,
    expand,
    refusal,
)
from dnnmso_mj.scenario.imperfections import Friction, Imperfections
from dnnmso_mj.scenario.inversion import Inversion
from dnnmso_mj.scenario.learning import Network, Observer
from dnnmso_mj.scenario.neural import LewisNn
from dnnmso_mj.scenario.optimizers import Adam, ByMadam, Madam, Rule, Sgd, SignSgd
from dnnmso_mj.scenario.policy import Policy
from dnnmso_mj.scenario.replay import DnnMsoReplay, KnownDelay
from dnnmso_mj.scenario.rivals import L1, Adrc, ComputedTorque, Pd, Pid, Rise, SlidingMode
from dnnmso_mj.scenario.safety import Safety

__all__ = [
    "L1",
    "PAPER_MODEL",
    "Adam",
    "Adrc",
    "Backstepping",
    "ByMadam",
    "ClassicalMso",
    "ComputedTorque",
    "ConcurrentLearning",
    "Constant",
    "Controller",
    "DnnMso",
    "DnnMsoReplay",
    "Effectiveness",
    "Event",
    "ExpSinusoid",
    "External",
    "ExternalImperfection",
    "ExternalReference",
    "Freeze",
    "Friction",
    "Imperfections",
    "Inertia",
    "Initial",
    "Inversion",
    "KnownDelay",
    "LewisNn",
    "Madam",
    "Network",
    "NoNetwork",
    "Observer",
    "Payload",
    "Pd",
    "Pid",
    "Plant",
    "Policy",
    "Push",
    "RbfMso",
    "RealTime",
    "Reference",
    "Rise",
    "Rule",
    "Safety",
    "Scenario",
    "Setpoint",
    "Sgd",
    "SignSgd",
    "Sinusoid",
    "SlidingMode",
    "SlotineLi",
    "Stall",
    "Waypoints",
    "expand",
]

PAPER_MODEL = "two_link"


class Plant(Strict):
    """The robot that MuJoCo steps."""

    model: str = PAPER_MODEL
    """MJCF: a shipped model's name, a path from this file, or package:file.xml of a package."""
    links: Literal["point_mass", "rod"] = "point_mass"
    """Mass of each link: a point at its tip, or a uniform thin rod."""
    masses: Positives | None = (1.0, 2.3)
    """Link masses (kg); null, the default of any model but two_link: what the MJCF says."""
    lengths: Positives | None = (1.0, 1.0)
    """Link lengths (m); null, the default of any model but two_link: what the MJCF says."""
    gravity: NonNegative = 9.81
    """Gravitational acceleration, along -z (m/s²)."""
    integrator: Literal["rk4", "euler", "implicitfast"] = "rk4"
    """MuJoCo's integrator."""

    @model_validator(mode="before")
    @classmethod
    def _own_links(cls, data: Any) -> Any:
        """The paper's masses and lengths are those of the paper's arm, and of no other model."""
        if isinstance(data, dict) and data.get("model", PAPER_MODEL) != PAPER_MODEL:
            return {"masses": None, "lengths": None, **data}
        return data

    @model_validator(mode="after")
    def _same_links(self) -> Plant:
        if (self.masses is None) != (self.lengths is None):
            given = "masses" if self.lengths is None else "lengths"
            raise refusal((given, "stands alone; allowed: masses and lengths both, or both null"))
        if self.masses and self.lengths and len(self.masses) != len(self.lengths):
            found, allowed = entries(len(self.lengths)), len(self.masses)
            raise refusal(("lengths", f"has {found}; allowed: {allowed}, as many as masses"))
        return self


class Initial(Strict):
    """Where the robot starts."""

    q: Vector = (0.5, 0.5)
    """Joint angles (rad)."""
    qd: FiniteEach = (0.0,)
    """Joint velocities (rad/s); one number stands for all joints."""


class Sinusoid(Strict):
    """q_ref,i(t) = offset_i + amplitude_i sin(frequency_i t + phase_i)."""

    kind: Literal["sinusoid"]
    """A sine at each joint; a cosine by its phase."""
    amplitude: FiniteEach = (1.0,)
    """Amplitude (rad)."""
    frequency: FiniteEach = (0.5,)
    """Angular frequency (rad/s)."""
    phase: FiniteEach = (0.0,)
    """Phase (rad); pi/2 makes a cosine."""
    offset: FiniteEach = (0.0,)
    """Centre of the oscillation (rad)."""


class ExpSinusoid(Strict):
    """q_ref,i(t) = amplitude_i exp(-sin(frequency_i t)) sin(frequency_i t + phase_i)."""

    kind: Literal["exp_sinusoid"]
    """A sine whose size swells and shrinks with it, of the Lyapunov-based DNN papers."""
    amplitude: FiniteEach = (0.25,)
    """Amplitude (rad) where the swelling is 1; it goes from 1/e to e."""
    frequency: FiniteEach = (1.0,)
    """Angular frequency (rad/s)."""
    phase: FiniteEach = (0.0,)
    """Phase (rad); pi/2 makes a cosine."""


class Setpoint(Strict):
    """Rest at `start`, one quintic (minimum-jerk) blend, rest at `goal`."""

    kind: Literal["setpoint"]
    """One move from rest to rest."""
    start: Vector
    """Joint angles before the move (rad)."""
    goal: Vector
    """Joint angles after the move (rad)."""
    start_time: NonNegative = 0.0
    """When the move begins (s)."""
    blend_time: Positive
    """How long the move takes (s)."""


class Waypoints(Strict):
    """A quintic spline through timed points, at rest before the first and after the last."""

    kind: Literal["waypoints"]
    """A smooth path through timed points."""
    times: Annotated[tuple[NonNegative, ...], Field(min_length=2), BeforeValidator(as_tuple)]
    """When each point is passed (s), strictly increasing."""
    points: Annotated[tuple[Vector, ...], Field(min_length=2), BeforeValidator(as_tuple)]
    """Joint angles at each time (rad)."""

    @model_validator(mode="after")
    def _ordered(self) -> Waypoints:
        if len(self.times) != len(self.points):
            found, allowed = entries(len(self.times)), len(self.points)
            raise refusal(("times", f"has {found}; allowed: {allowed}, one for each of points"))
        late = [k for k in range(1, len(self.times)) if self.times[k] <= self.times[k - 1]]
        if late:
            wrong = "is not after {}; allowed: strictly increasing times"
            raise refusal(*((f"times.{k}", wrong.format(self.times[k - 1])) for k in late))
        return self


Reference = Annotated[
    Sinusoid | ExpSinusoid | Setpoint | Waypoints | ExternalReference, Field(discriminator="kind")
]


class Stall(Strict):
    """A hang of the controller, to see what follows from it."""

    at: NonNegative
    """When (s)."""
    duration: Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)]
    """How long (s of the wall clock)."""


class RealTime(Strict):
    """What `dnnmso run --real-time` does where a command comes too late; else without effect."""

    watchdog: Literal["hold", "zero", "damped"] = "hold"
    """Torque of a period without a command in time: the last one, none, or -damping q̇."""
    damping: NonNegative = 5.0
    """Of the damped watchdog (N·m·s/rad)."""
    stalls: Annotated[tuple[Stall, ...], BeforeValidator(as_tuple)] = ()
    """Hangs of the controller, put in on purpose; each at the first update from its time on."""


class Scenario(Strict):
    """One experiment. Where the paper gives a number, it is the default."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
    """Letters, digits, '_', '.' and '-', at most 64; logs and figures are named after it."""
    description: str = ""
    """One or two sentences for people."""
    duration: Positive = 10.0
    """Simulated time (s); a whole number of steps."""
    dt: Annotated[float, Field(ge=1e-5, le=0.1, allow_inf_nan=False)] = 0.001
    """Control period and integration step (s)."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of the initial weights, and of all noise."""
    plant: Plant = Plant()
    """The robot."""
    initial: Initial = Initial()
    """Where it starts; the length of initial.q is the number of joints n."""
    reference: Reference
    """The motion to follow."""
    controller: Controller
    """What drives the robot."""
    imperfections: Imperfections = Imperfections()
    """What separates it from a robot; nothing unless given."""
    events: Annotated[tuple[Event, ...], BeforeValidator(as_tuple)] = ()
    """What happens at set times."""
    safety: Safety = Safety()
    """What stops the arm; nothing unless given."""
    real_time: RealTime = RealTime()
    """What happens when the wall clock is not kept."""

    @property
    def n_joints(self) -> int:
        """n, the number of joints: the length of initial.q."""
        return len(self.initial.q)

    @property
    def n_ticks(self) -> int:
        """N = duration/dt, the number of control periods."""
        return round(self.duration / self.dt)

    @model_validator(mode="after")
    def _agrees(self) -> Scenario:
        problems = contradictions(self)
        if problems:
            raise refusal(*problems)
        return self
