"""MuJoCo held against the analytic M, V, G and q̈, over random arms and random states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dnnmso_mj.dynamics import Links, TwoLink
from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.interrupts import raise_lost
from dnnmso_mj.plant import Mjcf, NominalModel, Plant, build_spec, compile_spec
from dnnmso_mj.scenario import PAPER_MODEL, DnnMso, Initial, Scenario, Sinusoid
from dnnmso_mj.scenario import Plant as PlantSpec

Array = np.ndarray

TOLERANCE = 1e-10
STATES_PER_ARM = 100
QUANTITIES = ("M", "V", "G", "qdd")


@dataclass(frozen=True)
class DynamicsCheck:
    """Largest difference of each quantity, relative to its scale on the arm concerned.

    The scale of a quantity is its largest magnitude over the states of one arm.
    """

    links: Links
    n_states: int
    n_arms: int
    errors: dict[str, float]

    @property
    def passed(self) -> bool:
        """Whether every error is a number within `TOLERANCE`."""
        return all(error <= TOLERANCE for error in self.errors.values())


def check_dynamics(
    mjcf: Mjcf, links: Links, n_states: int, seed: int = 0, name: str = PAPER_MODEL
) -> DynamicsCheck:
    """Compare over `n_states` random states of random arms, a new arm every 100 states.

    Masses 0.1 to 10 kg, lengths 0.2 to 2 m, gravity 0 to 20 m/s², any angle, velocities and
    torques of several rad/s and tens of N·m.

    Args:
        mjcf: a model with bodies link1 and link2.
        links: which analytic model.
        n_states: how many states.
        seed: of the draws.
        name: what messages call the model.

    Raises:
        ScenarioError: the model cannot be used, or is not a two-link arm.
    """
    _refuse_other_arms(mjcf, name)
    rng = np.random.default_rng(seed)
    worst = dict.fromkeys(QUANTITIES, 0.0)
    n_arms = -(-n_states // STATES_PER_ARM)
    for arm in range(n_arms):
        raise_lost()
        count = min(STATES_PER_ARM, n_states - arm * STATES_PER_ARM)
        for quantity, error in _compare_arm(mjcf, links, count, rng).items():
            worst[quantity] = float(
                np.fmax(worst[quantity], error) if np.isfinite(error) else np.inf
            )
    return DynamicsCheck(links, n_states, n_arms, worst)


def _refuse_other_arms(mjcf: Mjcf, name: str) -> None:
    """Before masses and lengths are set on it: an arm of two joints and two bodies."""
    as_it_is = PlantSpec(model=name, masses=None, lengths=None)
    model = compile_spec(build_spec(as_it_is, 1e-3, mjcf), name)
    bodies, joints = model.nbody - 1, model.njnt
    if (bodies, joints) != (2, 2):
        raise ScenarioError(
            f"plant.model = {name}: {bodies} bodies and {joints} joints; allowed: 2 and 2, since "
            "the formula is that of a two-link arm"
        )


def _compare_arm(
    mjcf: Mjcf, links: Links, count: int, rng: np.random.Generator
) -> dict[str, float]:
    m1, m2 = np.exp(rng.uniform(np.log(0.1), np.log(10.0), 2)).tolist()
    l1, l2 = rng.uniform(0.2, 2.0, 2).tolist()
    g = float(rng.uniform(0.0, 20.0))
    oracle = TwoLink((m1, m2), (l1, l2), g, links)
    q = rng.uniform(-np.pi, np.pi, (count, 2))
    qd = rng.normal(0.0, 4.0, (count, 2))
    tau = rng.normal(0.0, 40.0, (count, 2))
    expected = {
        "M": oracle.inertia(q),
        "V": oracle.coriolis(q, qd),
        "G": oracle.gravity_torque(q),
        "qdd": oracle.acceleration(q, qd, tau),
    }
    found = _from_mujoco(_arm(links, (m1, m2), (l1, l2), g), mjcf, q, qd, tau)
    return {name: _relative(found[name], expected[name]) for name in QUANTITIES}


def _arm(
    links: Links, masses: tuple[float, float], lengths: tuple[float, float], gravity: float
) -> Scenario:
    plant = PlantSpec(links=links, masses=masses, lengths=lengths, gravity=gravity)
    return Scenario(
        name="check",
        plant=plant,
        initial=Initial(q=(0.0, 0.0)),
        reference=Sinusoid(kind="sinusoid"),
        controller=DnnMso(kind="dnn_mso"),
    )


def _from_mujoco(
    scenario: Scenario, mjcf: Mjcf, q: Array, qd: Array, tau: Array
) -> dict[str, Array]:
    """M, V, G and q̈ by the very objects that a run uses."""
    plant, model = Plant(scenario, mjcf), NominalModel(scenario, mjcf)
    rest = np.zeros(2)
    out: dict[str, list[Array]] = {name: [] for name in QUANTITIES}
    for q_k, qd_k, tau_k in zip(q, qd, tau, strict=True):
        G = model.bias(q_k, rest).copy()
        out["M"].append(model.inertia(q_k).copy())
        out["G"].append(G)
        out["V"].append(model.bias(q_k, qd_k) - G)
        plant.reset(q_k, qd_k)
        out["qdd"].append(plant.acceleration(tau_k).copy())
    return {name: np.array(values) for name, values in out.items()}


def _relative(found: Array, expected: Array) -> float:
    scale = float(np.abs(expected).max())
    difference = float(np.abs(found - expected).max())
    return difference / scale if scale > 0 else difference
