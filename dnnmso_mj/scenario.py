"""The typed scenario: everything that decides a run, with units, ranges and the paper's values.

This module holds the shapes, and the rules within one of them; those that tie one to another are in
`dnnmso_mj.consistency`. Loading a file with line numbers and messages for people is
`dnnmso_mj.loading`'s work.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    WithJsonSchema,
    model_validator,
)
from pydantic_core import PydanticCustomError

from dnnmso_mj.consistency import contradictions, entries

MAX_WEIGHTS = 10_000_000
PAPER_MODEL = "two_link"


def _refusal(*problems: tuple[str, str]) -> PydanticCustomError:
    """An error about several values: (key path below this part, what is wrong with it)."""
    text = "; ".join(f"{path} {problem}" for path, problem in problems)
    return PydanticCustomError("refused", "{text}", {"text": text, "problems": problems})


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _vector(value: Any) -> Any:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return (value,) if is_number else _tuple(value)


def _number_or_list(item: dict[str, Any]) -> WithJsonSchema:
    return WithJsonSchema({"anyOf": [item, {"type": "array", "items": item, "minItems": 1}]})


Finite = Annotated[float, Field(allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
# Beyond these, sums of squares of weights or gradients leave the range of floating point.
WeightScale = Annotated[float, Field(ge=1e-3, le=1e3, allow_inf_nan=False)]
# The length stands before the conversion, or the JSON Schema would say minLength for minItems.
Vector = Annotated[tuple[Finite, ...], Field(min_length=1), BeforeValidator(_tuple)]
Positives = Annotated[tuple[Positive, ...], Field(min_length=1), BeforeValidator(_tuple)]
Matrix = Annotated[tuple[Vector, ...], Field(min_length=1), BeforeValidator(_tuple)]
# One number for all entries, or one for each; kept as a tuple and widened by `expand`.
PositiveEach = Annotated[
    tuple[Positive, ...],
    Field(min_length=1),
    BeforeValidator(_vector),
    _number_or_list({"type": "number", "exclusiveMinimum": 0}),
]
NonNegativeEach = Annotated[
    tuple[NonNegative, ...],
    Field(min_length=1),
    BeforeValidator(_vector),
    _number_or_list({"type": "number", "minimum": 0}),
]
FiniteEach = Annotated[
    tuple[Finite, ...],
    Field(min_length=1),
    BeforeValidator(_vector),
    _number_or_list({"type": "number"}),
]


def expand(values: tuple[float, ...], size: int) -> np.ndarray:
    """Widen one number to `size` entries; pass a full list through. Shape (size,)."""
    return np.full(size, values[0]) if len(values) == 1 else np.array(values, dtype=float)


class Strict(BaseModel):
    """Base of all parts: unknown keys, coercions and non-finite numbers are refused."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


class Plant(Strict):
    """The robot that MuJoCo steps."""

    model: str = PAPER_MODEL
    """MJCF: the name of a shipped model, or a path relative to the scenario file."""
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
            raise _refusal((given, "stands alone; allowed: masses and lengths both, or both null"))
        if self.masses and self.lengths and len(self.masses) != len(self.lengths):
            found, allowed = entries(len(self.lengths)), len(self.masses)
            raise _refusal(("lengths", f"has {found}; allowed: {allowed}, as many as masses"))
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
    times: Annotated[tuple[NonNegative, ...], Field(min_length=2), BeforeValidator(_tuple)]
    """When each point is passed (s), strictly increasing."""
    points: Annotated[tuple[Vector, ...], Field(min_length=2), BeforeValidator(_tuple)]
    """Joint angles at each time (rad)."""

    @model_validator(mode="after")
    def _ordered(self) -> Waypoints:
        if len(self.times) != len(self.points):
            found, allowed = entries(len(self.times)), len(self.points)
            raise _refusal(("times", f"has {found}; allowed: {allowed}, one for each of points"))
        late = [k for k in range(1, len(self.times)) if self.times[k] <= self.times[k - 1]]
        if late:
            wrong = "is not after {}; allowed: strictly increasing times"
            raise _refusal(*((f"times.{k}", wrong.format(self.times[k - 1])) for k in late))
        return self


Reference = Annotated[Sinusoid | Setpoint | Waypoints, Field(discriminator="kind")]


class Network(Strict):
    """The deep network f̂ and its initial weights."""

    hidden: Annotated[
        tuple[Annotated[int, Field(ge=1, le=4096)], ...],
        Field(min_length=1, max_length=32),
        BeforeValidator(_tuple),
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
            raise _refusal(("hidden", f"makes {weights} weights; {allowed}"))
        return self


class Madam(Strict):
    """Multiplicative adaptive moments, Alg. 1 of the paper."""

    eta: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] = 0.001
    """Learning rate η."""
    eta_max: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] = 0.1
    """η*, the largest exponent of one update; the paper's 100 η."""
    sigma_max: Annotated[float, Field(ge=1e-3, le=1e6, allow_inf_nan=False)] = 1250.0
    """σ*, the largest magnitude of a weight."""
    beta: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)] = 0.999
    """β, the forgetting factor of the second moment."""
    bias_correction: bool = False
    """Divide the second moment by 1 - β^k, as Adam does; the paper's algorithm does not."""

    @model_validator(mode="after")
    def _ordered(self) -> Madam:
        if self.eta_max < self.eta:
            problem = f"is below eta = {self.eta}; allowed: eta_max >= eta"
            raise _refusal(("eta_max", problem))
        return self


def _resolvable(madam: Madam, network: Network) -> None:
    """Refuse learning whose smallest steps are rounded away in the network's arithmetic."""
    eps = float(np.finfo(network.precision).eps)
    least = f"2^{round(np.log2(eps))} = {eps:.2g}, what {network.precision} resolves"
    if madam.eta < eps:
        raise _refusal(
            ("madam.eta", f"would leave every weight as it is; allowed: {least}, or more")
        )
    if 1 - madam.beta < eps:
        problem = f"would never take in a gradient; allowed: 1 - beta of {least}, or more"
        raise _refusal(("madam.beta", problem))


class Observer(Strict):
    """The state observer of Eq. 5."""

    K2: PositiveEach = (30.0,)
    """Observer gain (1/s): one number, or one for each of the 2n states."""
    feedback: Literal["stable", "as_printed"] = "stable"
    """stable: +K₂(X - X̂). as_printed: the paper's sign, which diverges."""


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
            raise _refusal(("slack_matrix", problem))
        upper = np.array(self.slack_matrix[: rows // 2])
        if np.linalg.matrix_rank(upper) < rows // 2:
            problem = "leaves [B B_s] without an inverse; allowed: regular upper n rows"
            raise _refusal(("slack_matrix", problem))
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
    """The weight update."""

    @model_validator(mode="after")
    def _learns(self) -> DnnMso:
        _resolvable(self.madam, self.network)
        return self


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
    """The weight update."""

    @model_validator(mode="after")
    def _needs_a_model(self) -> ClassicalMso:
        if isinstance(self.inversion.effectiveness, Constant):
            problem = "leaves classical_mso without a model of the plant; allowed: inertia"
            raise _refusal(("inversion.effectiveness.kind", problem))
        if self.network.outputs != "full":
            problem = "has no meaning for classical_mso, which learns a torque; allowed: full"
            raise _refusal(("network.outputs", problem))
        _resolvable(self.madam, self.network)
        return self


Controller = Annotated[DnnMso | NoNetwork | ClassicalMso, Field(discriminator="kind")]


class Imperfections(Strict):
    """What separates the simulation from a robot."""

    torque_limit: PositiveEach | None = None
    """Largest |torque| of each joint's actuator (N·m); null: none."""


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
    stalls: Annotated[tuple[Stall, ...], BeforeValidator(_tuple)] = ()
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
    """Seed of the initial weights."""
    plant: Plant = Plant()
    """The robot."""
    initial: Initial = Initial()
    """Where it starts; the length of initial.q is the number of joints n."""
    reference: Reference
    """The motion to follow."""
    controller: Controller
    """What drives the robot."""
    imperfections: Imperfections = Imperfections()
    """Limits of the robot's parts; none unless given."""
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
            raise _refusal(*problems)
        return self
