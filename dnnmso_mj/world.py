"""What a tick touches, made of a scenario."""

from __future__ import annotations

import numpy as np

from dnnmso_mj.controllers import Inputs
from dnnmso_mj.imperfections.actuators import build_actuators
from dnnmso_mj.imperfections.loads import build_loads
from dnnmso_mj.imperfections.sensors import Sensors
from dnnmso_mj.imperfections.tip import Tip
from dnnmso_mj.memory_recorder import LARGEST_BLOCK
from dnnmso_mj.plant import RK4, Nominal, Plant
from dnnmso_mj.safety import build_safety
from dnnmso_mj.scenario import Constant, Scenario
from dnnmso_mj.scenario.controller import effectiveness, inversion, lookahead
from dnnmso_mj.theory import build_bounds
from dnnmso_mj.tick import N_COUNTS, Pace, World

CHUNK = 1000  # ticks of the reference sampled at once


def build_world(
    scenario: Scenario,
    plant: Plant,
    tip: Tip | None,
    sensors: Sensors,
    nominal: Nominal,
    pace: Pace,
    width: int,
) -> World:
    """The world of a scenario, not yet started.

    Args:
        scenario: the experiment.
        plant: its robot.
        tip: of the robot's last link, if the scenario has events there.
        sensors: of the robot, with a chunk of CHUNK ticks.
        nominal: what the controller takes for the robot.
        pace: how ticks follow the wall clock.
        width: of a row.
    """
    n, dt = scenario.n_joints, scenario.dt
    believed, law = effectiveness(scenario.controller), inversion(scenario.controller)
    reference = np.zeros((CHUNK, 3 * n))
    x, x_ref, xd_ref, e_track, f_true, f_err = np.zeros((6, 2 * n))
    return World(
        plant=plant.view,
        sensors=sensors,
        actuators=build_actuators(scenario.imperfections, n, dt),
        loads=build_loads(scenario, plant, tip),
        safety=build_safety(scenario.safety, n, dt),
        bounds=build_bounds(law, n, dt, first_order=plant.view.integrator != RK4),
        pace=pace,
        reference=reference,
        ahead=np.zeros_like(reference) if lookahead(scenario.controller) else reference,
        x=x,
        x_ref=x_ref,
        xd_ref=xd_ref,
        inputs=Inputs.zeros(n),
        e_track=e_track,
        f_true=f_true,
        f_err=f_err,
        tau=np.zeros(n),
        qdd=np.zeros(n),
        L=np.zeros((n, n)),
        nominal=nominal,
        b=believed.b if isinstance(believed, Constant) else 0.0,
        inverts=law is not None,
        rows=np.zeros((LARGEST_BLOCK, width)),
        counts=np.zeros(N_COUNTS, np.int64),
        late_ns=np.zeros(1, np.int64),
        timespec=np.zeros(2, np.int64),
        dt=dt,
    )
