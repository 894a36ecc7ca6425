"""Rivals without learning, from their parts of a scenario."""

from __future__ import annotations

from dnnmso_mj.controllers import Controller
from dnnmso_mj.controllers.adrc import AdrcController
from dnnmso_mj.controllers.computed_torque import ComputedTorqueController
from dnnmso_mj.controllers.l1 import L1Controller
from dnnmso_mj.controllers.pd import PdController
from dnnmso_mj.controllers.pid import PidController
from dnnmso_mj.controllers.rise import RiseController
from dnnmso_mj.controllers.sliding_mode import SlidingModeController
from dnnmso_mj.plant import NominalModel
from dnnmso_mj.scenario import L1, Adrc, ComputedTorque, Pd, Pid, Rise, SlidingMode
from dnnmso_mj.scenario.rivals import Rival


def build_rival(spec: Rival, n_joints: int, dt: float, nominal: NominalModel) -> Controller:
    """The controller of a rival's part of a scenario.

    Args:
        spec: the part.
        n_joints: n.
        dt: control period (s).
        nominal: the controller's own model of the robot.
    """
    controller: Controller
    match spec:
        case Pd():
            controller = PdController(spec, n_joints)
        case Pid():
            controller = PidController(spec, n_joints, dt)
        case ComputedTorque():
            controller = ComputedTorqueController(spec, n_joints, nominal)
        case Adrc():
            controller = AdrcController(spec, n_joints, dt, nominal)
        case SlidingMode():
            controller = SlidingModeController(spec, n_joints, nominal)
        case Rise():
            controller = RiseController(spec, n_joints, dt)
        case L1():
            controller = L1Controller(spec, n_joints, dt, nominal)
    return controller
