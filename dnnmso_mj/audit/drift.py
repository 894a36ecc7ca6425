"""The drift: accelerations at zero torque, of the true plant and of a controller's model.

q̈ = M⁻¹(q) (τ − V(q, q̇) − G(q))  ⇒  f₂(x) = −M⁻¹ (V + G)
"""

from __future__ import annotations

import mujoco
import numpy as np

from dnnmso_mj.controllers import Controller
from dnnmso_mj.plant import Plant

Array = np.ndarray


def true_drift(plant: Plant, states: Array) -> Array:
    """f₂ (N, n) rad/s² of the plant as it is now, by MuJoCo, at states (N, 2n); it stays as it is.

    N.B. friction and other disturbances that a scenario adds to the joints' torques are no part of
    it.
    """
    model, n = plant.model, plant.model.nv
    data = mujoco.MjData(model)
    out = np.empty((len(states), n))
    for x, row in zip(states, out, strict=True):
        data.qpos[:], data.qvel[:] = x[:n], x[n:]
        mujoco.mj_forward(model, data)
        row[:] = data.qacc
    return out


def learned_drift(controller: Controller, states: Array) -> Array:
    """f̂₂ (N, n) rad/s² that the controller's present model predicts at states (N, 2n)."""
    return np.array([controller.dynamics(x).copy() for x in states])
