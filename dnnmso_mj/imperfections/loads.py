"""Torques on the joints that are not the motors': friction, and pushes from outside.

Both are held through a period, as the motors' torque is. A force f at the tip acts by Jᵀ f with the
tip's Jacobian J(q) at the tick.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import compiled, copy, inner
from dnnmso_mj.imperfections.friction import friction_law, rub
from dnnmso_mj.mujoco_calls import mj_comPos, mj_forward, mj_jac, mj_kinematics
from dnnmso_mj.plant import PlantView, forward
from dnnmso_mj.scenario import Friction, expand

Array = np.ndarray


class Loads(NamedTuple):
    """What acts beside the motors; all zero where nothing does."""

    torque: Array  # (n,) N·m in this period
    before: Array  # (n,) N·m in the period before
    push: Array  # (n,) N·m on the joints from outside
    force: Array  # (3,) N at the tip from outside
    place: Array  # (3,) m, the tip in its body's frame
    body: int
    frame: Array
    law: Array  # (3, n) of dry friction
    rubbed: Array  # (n,) N·m, friction alone
    scratch: Array  # (2, n, n), and
    jacobian: Array  # (3, n)
    acting: bool  # whether anything may ever act
    dry: bool
