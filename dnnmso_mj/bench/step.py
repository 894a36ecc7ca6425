"""The control step: predict and learn once, for one sample, against other ways to write it."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Protocol

import numpy as np

from dnnmso_mj.bench.numpy_step import NumpyStep
from dnnmso_mj.bench.roofline import Roofline, measure_roofline
from dnnmso_mj.bench.timing import Check, Contender, Probe, Row, Table, race, timed
from dnnmso_mj.learner import build_learner
from dnnmso_mj.network import Shape, initial_weights, network_shape
from dnnmso_mj.scenario import Madam as MadamSpec
from dnnmso_mj.scenario import Network as NetworkSpec

Array = np.ndarray

N_STATES = 4
SEED = 0
OURS = "dnnmso_mj"
TOLERANCE = {"float32": 1e-3, "float64": 1e-9}


class Stepper(Protocol):
    """A network that learns online."""

    def predict(self, x: Array) -> Array:
        """Output (n_out,) for x (n_in,)."""

    def learn(self, delta: Array) -> None:
        """One update from ∂loss/∂output (n_out,)."""

    def weights(self) -> Array:
        """All weights, flat (n_weights,), in the order of `Shape`."""


Make = Callable[[NetworkSpec], Stepper]


class Ours:
    """The package's learner through its public interface, with the weights in reach."""

    def __init__(self, network: NetworkSpec, n_states: int) -> None:
        self._learner = build_learner(network, MadamSpec(), n_states, n_states, SEED)
        self.predict, self.learn = self._learner.predict, self._learner.learn

    def weights(self) -> Array:
        return self._learner.state()["weights"]


def ours(network: NetworkSpec, n_states: int = N_STATES) -> Stepper:
    """This package's compiled step."""
    return Ours(network, n_states)


def plain_torch(network: NetworkSpec, n_states: int = N_STATES) -> Stepper:
    """torch as most would write it."""
    from dnnmso_mj.bench.torch_steps import PlainTorch

    return PlainTorch(*_initial(network, n_states), MadamSpec())


def flat_torch(network: NetworkSpec, n_states: int = N_STATES) -> Stepper:
    """torch with a hand-written backward pass over one flat vector."""
    from dnnmso_mj.bench.torch_steps import FlatTorch

    return FlatTorch(*_initial(network, n_states), MadamSpec())


def numpy_step(network: NetworkSpec, n_states: int = N_STATES) -> Stepper:
    """NumPy with a hand-written backward pass over one flat vector."""
    return NumpyStep(*_initial(network, n_states), MadamSpec())


def step_probe(make: Make, network: NetworkSpec, calls: int, n_states: int = N_STATES) -> Probe:
    """Times single predict-and-learn steps (µs)."""
    stepper = make(network)
    feed = itertools.cycle(samples(network.precision, n_states, 512))

    def step() -> None:
        x, delta = next(feed)
        stepper.predict(x)
        stepper.learn(delta)

    return timed(step, calls)


def samples(precision: str, n_states: int, count: int) -> list[tuple[Array, Array]]:
    """Pairs of an input and a gradient of the loss, the same for every contender."""
    rng = np.random.default_rng(SEED)
    x = rng.normal(size=(count, n_states)).astype(precision)
    delta = rng.normal(scale=0.1, size=(count, n_states)).astype(precision)
    return list(zip(x, delta, strict=True))


def bench_step(quick: bool) -> list[Table]:
    """The paper's network, float32 and float64, against torch, NumPy and the machine's limits."""
    calls, rounds = (100, 3) if quick else (1000, 20)
    f32, f64 = NetworkSpec(precision="float32"), NetworkSpec(precision="float64")
    arithmetic = "vector arithmetic, then two calls from Python"
    interpreter = "the interpreter: many small calls"
    contenders = [
        Contender(f"{OURS}, float32", arithmetic, _probe(ours, f32, calls)),
        Contender(f"{OURS}, float64", arithmetic, _probe(ours, f64, calls)),
        Contender("plain PyTorch, float32", interpreter, _probe(plain_torch, f32, calls)),
        Contender("PyTorch by hand, float32", interpreter, _probe(flat_torch, f32, calls)),
        Contender("NumPy by hand, float32", interpreter, _probe(numpy_step, f32, calls)),
    ]
    rows = race(contenders, rounds)
    shape = network_shape(f32, N_STATES, N_STATES)
    rooflines = [measure_roofline(shape, spec.precision, quick) for spec in (f32, f64)]
    bounds = tuple(_bound_row(roof, rows[0], i) for i, roof in enumerate(rooflines))
    details: dict[str, float] = {}
    for roof in rooflines:
        parts = roof.us | {"divide by a root, exactly": roof.exact_root_us}
        details |= {f"bound, {roof.precision}, {name}": value for name, value in parts.items()}
    hidden = "-".join(map(str, shape.sizes))
    return [
        Table(
            name="step",
            title=f"Control step, {hidden} network",
            work=(
                "forward, backward, Madam, one sample; plain: nn.Sequential, autograd and an "
                "optimiser; by hand: own backward pass, one vector; bound: this machine's"
            ),
            unit="µs",
            rows=rows + bounds,
            checks=check_steps(200),
            details=details,
        )
    ]


def _probe(make: Make, network: NetworkSpec, calls: int) -> Callable[[], Probe]:
    return partial(step_probe, make, network, calls)


def _bound_row(roof: Roofline, first: Row, index: int) -> Row:
    name = f"lower bound, {roof.precision}"
    ratio = roof.bound_us / first.median if index == 0 and first.median else None
    return Row(name, roof.binding, median=roof.bound_us, ratio=ratio,
               versus=first.name if ratio else "")  # fmt: skip


def check_steps(steps: int) -> tuple[Check, ...]:
    """Every contender that is installed, in every precision that it is timed or trusted in."""
    cases: list[tuple[str, Make, str]] = [
        ("plain PyTorch", plain_torch, "float64"),
        ("PyTorch by hand", flat_torch, "float64"),
        ("NumPy by hand", numpy_step, "float64"),
        (OURS, ours, "float32"),
        ("plain PyTorch", plain_torch, "float32"),
        ("PyTorch by hand", flat_torch, "float32"),
        ("NumPy by hand", numpy_step, "float32"),
    ]
    checks = []
    for name, make, precision in cases:
        with suppress(ImportError):
            checks.append(check_step(name, make, precision, steps))
    return tuple(checks)


def check_step(name: str, make: Make, precision: str, steps: int) -> Check:
    """A contender against this package in float64: how far learning moved the weights.

    The error is ‖w − w_ours‖/‖w_ours − w_0‖ after `steps` steps, so that an agreement of the
    initial weights alone counts for nothing.
    """
    reference = _learned(ours, "float64", steps)
    start = _initial(NetworkSpec(), N_STATES)[1]
    moved = float(np.linalg.norm(reference - start))
    error = float(np.linalg.norm(_learned(make, precision, steps) - reference)) / moved
    what = f"{name}, {precision}: weights after {steps} steps"
    return Check(what, error, TOLERANCE[precision])


def _learned(make: Make, precision: str, steps: int) -> Array:
    network = NetworkSpec.model_validate({"precision": precision})
    stepper = make(network)
    feed = itertools.cycle(samples(precision, N_STATES, 512))
    for x, delta in itertools.islice(feed, steps):
        stepper.predict(x)
        stepper.learn(delta)
    return stepper.weights().astype(float)


def _initial(network: NetworkSpec, n_states: int) -> tuple[Shape, Array]:
    shape = network_shape(network, n_states, n_states)
    weights = initial_weights(shape, network, np.random.default_rng(SEED))
    return shape, weights.astype(network.precision)
