"""What to warn of: scenarios that can be run, but that no controller can do well."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import accumulate

import numpy as np

from dnnmso_mj.dynamics import centre_and_inertia
from dnnmso_mj.scenario import Inertia, NoNetwork, Plant, Scenario, expand
from dnnmso_mj.scenario.controller import inversion as inversion_of
from dnnmso_mj.wording import KeyPath

UNSTABLE = "makes the loop, sampled each dt, unstable even with an exact model"


def advice(scenario: Scenario) -> Iterator[tuple[KeyPath, str]]:
    """Key paths, and what is wrong with them."""
    for problem in _overloads(scenario):
        yield ("imperfections", "torque_limit"), problem
    for problem in _stuck(scenario):
        yield ("imperfections", "friction"), problem
    yield from _gains(scenario)


def stretched_load(plant: Plant, payload: float = 0.0) -> np.ndarray:
    """The largest static gravity load, of the arm stretched out level: N·m, shape (n,).

    Joint i carries g Σ_{j≥i} m_j d_ij, with d_ij the distance along the arm from joint i to link
    j's centre of mass, and a payload (kg) at the tip. Empty where the model brings its own masses.
    """
    if plant.masses is None or plant.lengths is None:
        return np.zeros(0)
    lengths = np.array(plant.lengths)
    links = zip(plant.masses, plant.lengths, strict=True)
    centres = np.array([centre_and_inertia(plant.links, mass, length)[0] for mass, length in links])
    joints = np.concatenate(([0.0], np.cumsum(lengths)[:-1]))
    arms = (joints + centres)[None, :] - joints[:, None]
    with np.errstate(over="ignore"):
        moments = np.triu(arms * np.array(plant.masses)).sum(axis=1)
        load: np.ndarray = plant.gravity * (moments + payload * (lengths.sum() - joints))
    return load


def _most_carried(scenario: Scenario) -> float:
    """The heaviest payload (kg) of a run; 0 if nothing is ever taken up."""
    payloads = [event for event in scenario.events if event.kind == "payload"]
    masses = [event.mass for event in sorted(payloads, key=lambda event: event.at)]
    return max(accumulate(masses, initial=0.0))


def _overloads(scenario: Scenario) -> Iterator[str]:
    """What to warn of: each joint whose limit is under its static load."""
    limit, payload = scenario.imperfections.torque_limit, _most_carried(scenario)
    load = stretched_load(scenario.plant, payload)
    if limit is None or load.size == 0:
        return
    arm = f"the arm with {payload:.4g} kg at its tip" if payload else "the arm"
    for k, (most, needed) in enumerate(zip(expand(limit, load.size), load, strict=True), start=1):
        if most < needed:
            yield (
                f"joint {k} is limited to {most:.4g} N·m, under the static gravity load of "
                f"{needed:.4g} N·m of {arm} stretched out level; no controller can hold it"
            )


def _stuck(scenario: Scenario) -> Iterator[str]:
    """What to warn of: each joint whose motor cannot overcome its dry friction."""
    n, parts = scenario.n_joints, scenario.imperfections
    if parts.torque_limit is None:
        return
    limits = expand(parts.torque_limit, n)
    holds = expand(parts.friction.breakaway or parts.friction.coulomb, n)
    for k, (most, held) in enumerate(zip(limits, holds, strict=True), start=1):
        if held >= most:
            yield (
                f"joint {k} is held by {held:.4g} N·m, and its motor is limited to {most:.4g} N·m; "
                "no controller can move it from rest"
            )


def _gains(scenario: Scenario) -> Iterator[tuple[KeyPath, str]]:
    """Gains with which even an exact model, held over a step dt, is driven out of control.

    On an exactly inverted plant the loop is ë = -k_d ė - k_p e with k_d = K₂ + λ and k_p = λ K₁
    (K₁, K₂: gains of angles and velocities). Its torque held over a step, the loop is stable only
    while k_d dt < 2 and k_p dt < 2 k_d (Jury's conditions).
    """
    controller = scenario.controller
    inversion = inversion_of(controller)
    if inversion is None or inversion.slack_matrix is not None:
        return
    if not isinstance(inversion.effectiveness, Inertia):
        return
    n, dt = scenario.n_joints, scenario.dt
    K = expand(inversion.K, 2 * n)
    sees_velocity = not isinstance(controller, NoNetwork) or controller.kinematics
    lam = inversion.lam
    damping = K[n:] + lam if sees_velocity else K[n:]
    path: KeyPath = ("controller", "inversion", "lam" if lam > K.max() else "K")
    if damping.max() * dt >= 2:
        of = "K + lam" if sees_velocity else "K"
        yield (
            path,
            f"{UNSTABLE}; stable: {of} < 2/dt = {2 / dt:g}",
        )
    elif (lam * K[:n] * dt >= 2 * damping).any():
        yield path, f"{UNSTABLE}; stable: lam K dt < 2 (K + lam)"
