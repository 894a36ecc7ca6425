"""Torques on the joints that are not the motors': friction, and pushes from outside.

Both are held through a period, as the motors' torque is. A force f at the tip acts by Jᵀ f with the
tip's Jacobian J(q) at the tick.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import compiled, inner
from dnnmso_mj.imperfections.friction import HELD, N_PARTS, UNIT, friction_law, rub
from dnnmso_mj.imperfections.tip import Tip
from dnnmso_mj.mujoco_calls import mj_comPos, mj_jacSite, mj_kinematics
from dnnmso_mj.plant import Plant, PlantView, forward
from dnnmso_mj.scenario import Push, Scenario, expand

Array = np.ndarray

# Rows of `Loads.held`.
BEFORE, FRICTION = range(2)


class Loads(NamedTuple):
    """What acts beside the motors. N.B. few arrays: each makes the loop compile longer."""

    torque: Array  # (n,) N·m in this period: all of it, as MuJoCo sees it
    held: Array  # (2, n) N·m: all of it in the period before; the dry friction in it
    push: Array  # (n + 3,) from outside: N·m on the joints, N at the tip
    law: Array  # (3, n) of dry friction
    scratch: Array  # (N_PARTS, max(n, 4), n): see `friction.rub`
    site: int  # MuJoCo's, of the tip
    acting: bool  # whether anything may ever act
    dry: bool  # whether there is dry friction


def build_loads(scenario: Scenario, plant: Plant, tip: Tip | None) -> Loads:
    """The loads of a scenario; viscous friction becomes damping of the plant's own model.

    Args:
        scenario: for its friction and pushes.
        plant: what they act on.
        tip: of its last link, if the scenario has events there.
    """
    n, friction = scenario.n_joints, scenario.imperfections.friction
    plant.damp(expand(friction.viscous, n))
    scratch = np.zeros((N_PARTS, max(n, 4), n))
    scratch[UNIT, :n] = np.eye(n)
    return Loads(
        torque=plant.applied,
        held=np.zeros((2, n)),
        push=np.zeros(n + 3),
        law=friction_law(friction, n),
        scratch=scratch,
        site=tip.site if tip else -1,
        acting=friction.is_dry or any(isinstance(event, Push) for event in scenario.events),
        dry=friction.is_dry,
    )


def start_loads(loads: Loads) -> None:
    """As before the first period: nothing acts."""
    for array in (loads.torque, loads.held, loads.push):
        array[:] = 0.0


@inner
def load(loads: Loads, plant: PlantView, tau: Array, dt: float, most: float) -> bool:
    """Begin a period in which the motors give τ (n,) N·m: true q̈ under it and all loads.

    False where a load is above `most` or no number: then MuJoCo is not given it.
    """
    if loads.acting:
        _push(
            plant.model, plant.data, loads.site, loads.push, loads.held, loads.torque, loads.scratch
        )
        if loads.dry and is_within(loads.torque, most):
            forward(plant, tau)
            rub(
                plant.model,
                plant.data,
                dt,
                plant.qd,
                plant.qacc,
                loads.law,
                loads.scratch,
                loads.held[FRICTION],
            )
            for j in range(tau.size):
                loads.torque[j] += loads.held[FRICTION, j]
    within = True
    for j in range(tau.size):
        within = within and abs(loads.torque[j]) <= most
    if within:
        forward(plant, tau)
    return within


@compiled
def is_within(values: Array, most: float) -> bool:
    """Whether every |value| is a number of at most `most`."""
    within = True
    for value in values:
        within = within and abs(value) <= most
    return within


@compiled
def _push(
    model: int, data: int, site: int, push: Array, held: Array, torque: Array, scratch: Array
) -> None:
    """The last period's torque into `held`, and what pushes now into `torque`."""
    n = torque.size
    for j in range(n):
        held[BEFORE, j] = torque[j]
        torque[j] = push[j]
    if push[n] == 0.0 and push[n + 1] == 0.0 and push[n + 2] == 0.0:
        return
    jacobian = scratch[HELD]
    mj_kinematics(model, data)
    mj_comPos(model, data)
    mj_jacSite(model, data, jacobian.ctypes.data, 0, site)
    for j in range(n):
        for i in range(3):
            torque[j] += jacobian[i, j] * push[n + i]
