"""Torques on the joints that are not the motors': friction, and pushes from outside.

Both are held through a period, as the motors' torque is. A force f at the tip acts by Jᵀ f with the
tip's Jacobian J(q) at the tick.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import compiled, copy, inner
from dnnmso_mj.imperfections.friction import friction_law, rub
from dnnmso_mj.imperfections.tip import Tip
from dnnmso_mj.mujoco_calls import mj_comPos, mj_jac, mj_kinematics
from dnnmso_mj.plant import Plant, PlantView, forward
from dnnmso_mj.scenario import Push, Scenario, expand

Array = np.ndarray


class Loads(NamedTuple):
    """What acts beside the motors."""

    torque: Array  # (n,) N·m in this period: all of it, as MuJoCo sees it
    before: Array  # (n,) N·m in the period before
    push: Array  # (n,) N·m on the joints from outside
    force: Array  # (3,) N at the tip from outside
    place: Array  # (3,) m, the tip in its body's frame
    body: int
    origin: Array  # (3,) m, of that body in the world, and
    axes: Array  # (9,) its rotation, both MuJoCo's own
    law: Array  # (3, n) of dry friction
    dry_torque: Array  # (n,) N·m, dry friction alone
    scratch: Array  # (2, n, n), the identity first
    point: Array  # (3,) scratch
    jacobian: Array  # (3, n) scratch
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
    body = tip.body if tip else 0
    origin, axes = plant.body_frame(body)
    return Loads(
        torque=plant.applied,
        before=np.zeros(n),
        push=np.zeros(n),
        force=np.zeros(3),
        place=tip.place if tip else np.zeros(3),
        body=body,
        origin=origin,
        axes=axes,
        law=friction_law(friction, n),
        dry_torque=np.zeros(n),
        scratch=np.stack([np.eye(n), np.zeros((n, n))]),
        point=np.zeros(3),
        jacobian=np.zeros((3, n)),
        acting=friction.is_dry or any(isinstance(event, Push) for event in scenario.events),
        dry=friction.is_dry,
    )


def start_loads(loads: Loads) -> None:
    """As before the first period: nothing acts."""
    for array in (loads.torque, loads.before, loads.push, loads.force, loads.dry_torque):
        array[:] = 0.0


@inner
def load(loads: Loads, plant: PlantView, tau: Array, dt: float) -> None:
    """Begin a period in which the motors give τ (n,) N·m: true q̈ under it and all loads."""
    if loads.acting:
        copy(loads.torque, loads.before)
        copy(loads.push, loads.torque)
        _push_tip(loads, plant.model, plant.data)
        if loads.dry:
            forward(plant, tau)
            rub(
                plant.model,
                plant.data,
                dt,
                plant.qd,
                plant.qacc,
                loads.law,
                loads.scratch,
                loads.dry_torque,
            )
            for j in range(tau.size):
                loads.torque[j] += loads.dry_torque[j]
    forward(plant, tau)


@compiled
def _push_tip(loads: Loads, model: int, data: int) -> None:
    """Add Jᵀ f to the torques."""
    force, point, jacobian = loads.force, loads.point, loads.jacobian
    if force[0] == 0.0 and force[1] == 0.0 and force[2] == 0.0:
        return
    mj_kinematics(model, data)
    mj_comPos(model, data)
    for i in range(3):
        point[i] = loads.origin[i]
        for j in range(3):
            point[i] += loads.axes[3 * i + j] * loads.place[j]
    mj_jac(model, data, jacobian.ctypes.data, 0, point.ctypes.data, loads.body)
    for j in range(loads.torque.size):
        for i in range(3):
            loads.torque[j] += jacobian[i, j] * force[i]
