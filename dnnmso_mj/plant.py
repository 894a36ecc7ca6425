"""The robot that MuJoCo steps, and the controller's own nominal model of it.

MuJoCo is wrapped here and nowhere else on the control path: a plant is built from a scenario, takes
torques, and is read by joint angle and velocity.
"""

from __future__ import annotations

import logging
import math
from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from dnnmso_mj.compiling import compiled, copy, inner, is_finite
from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.links import set_links
from dnnmso_mj.mjcf import gate, read
from dnnmso_mj.mujoco_calls import (
    mj_comPos,
    mj_Euler,
    mj_forward,
    mj_fullM,
    mj_fwdPosition,
    mj_fwdVelocity,
    mj_implicit,
    mj_kinematics,
    mj_makeM,
    mj_RungeKutta,
    mj_solveM,
)
from dnnmso_mj.scenario import Inertia, Scenario
from dnnmso_mj.scenario import Plant as PlantSpec
from dnnmso_mj.scenario.controller import effectiveness, inversion
from dnnmso_mj.unmodelled import refuse_unmodelled

Array = np.ndarray

INTEGRATORS = {
    "rk4": mujoco.mjtIntegrator.mjINT_RK4,
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}
WHOLE = mujoco.mjtState.mjSTATE_INTEGRATION
RK4, EULER = int(INTEGRATORS["rk4"]), int(INTEGRATORS["euler"])

HULL_VERTICES = 64
TIP = "tip"  # the site at the far end of the last link

LOGGER = logging.getLogger(__name__)


def _tell(warning: str) -> None:
    LOGGER.warning("MuJoCo: %s", warning)


# Otherwise MuJoCo leaves a file MUJOCO_LOG.TXT in the current folder. Its C code calls this, so it
# must never raise.
mujoco.set_mju_user_warning(_tell)


@dataclass(frozen=True)
class Mjcf:
    """An MJCF as text without includes, and the folder that its assets are relative to.

    There is none that `dnnmso_mj.mjcf.gate` has not let in.

    Raises:
        ScenarioError: the gate refuses it.
    """

    text: str
    folder: str = ""

    def __post_init__(self) -> None:
        gate(self.text, self.folder)

    @classmethod
    def read(cls, path: Path) -> Mjcf:
        """Read the file at `path`, its includes put in their places.

        Raises:
            ScenarioError: it cannot be read, or the gate refuses it.
        """
        return cls(read(path), str(path.parent))

    @property
    def checked(self) -> str:
        """What MuJoCo is given: the text as the gate understood it."""
        return gate(self.text, self.folder)


def build_spec(plant: PlantSpec, dt: float, mjcf: Mjcf) -> mujoco.MjSpec:
    """Give an MJCF the scenario's masses, lengths, gravity and step.

    Raises:
        ScenarioError: MuJoCo cannot read the file, or it is not the chain of bodies link1 … linkn
            that masses and lengths are set on.
    """
    try:
        spec = mujoco.MjSpec.from_string(mjcf.checked)
    except ValueError as error:
        raise ScenarioError(f"plant.model = {plant.model}: MuJoCo says: {error}") from error
    spec.modelfiledir = mjcf.folder
    spec.option.timestep = dt
    spec.option.gravity = [0.0, 0.0, -plant.gravity]
    spec.option.integrator = INTEGRATORS[plant.integrator]
    # Without this MuJoCo answers a NaN by moving the arm back to its start, silently.
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    for mesh in spec.meshes:  # hulls are for contacts, which no plant has, and slow to make
        if mesh.inertia != mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX:
            mesh.maxhullvert = HULL_VERTICES
    if plant.masses is not None and plant.lengths is not None:
        set_links(spec, plant.links, plant.masses, plant.lengths)
        if spec.site(TIP) is None:
            tip = spec.body(f"link{len(plant.lengths)}")
            tip.add_site(name=TIP, pos=[plant.lengths[-1], 0.0, 0.0])
    return spec


def compile_spec(spec: mujoco.MjSpec, name: str) -> mujoco.MjModel:
    """Compile, and refuse what the testbed cannot drive: other joints, actuators and forces.

    Raises:
        ScenarioError: naming the model and what it has too much or too little of.
    """
    try:
        model = spec.compile()
    except ValueError as error:
        raise ScenarioError(f"plant.model = {name}: MuJoCo says: {error}") from error
    simple = {int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)}
    if model.nv == 0 or not set(model.jnt_type.tolist()) <= simple:
        raise ScenarioError(
            f"plant.model = {name}: {model.njnt} joints with {model.nv} degrees of freedom; "
            "allowed: at least one joint, hinges and slides only"
        )
    direct = (
        model.nu == model.nv
        and np.all(model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
        and np.array_equal(model.actuator_trnid[:, 0], np.arange(model.nv))
        and np.all(model.actuator_gear[:, 0] == 1.0)
        and np.all(model.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE)
        and np.all(model.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED)
        and np.all(model.actuator_biastype == mujoco.mjtBias.mjBIAS_NONE)
        and not np.any(model.actuator_ctrllimited)
    )
    if not direct:
        raise ScenarioError(
            f"plant.model = {name}: {model.nu} actuators for {model.nv} joints; allowed: one "
            '<motor gear="1"> a joint, in the order of the joints, without ctrlrange (torque '
            "limits belong to the scenario)"
        )
    refuse_unmodelled(model, name)
    return model


# A sweep builds the same few models thousands of times; whoever takes one takes a copy.
@lru_cache(maxsize=16)
def _plant_model(plant: PlantSpec, dt: float, mjcf: Mjcf) -> mujoco.MjModel:
    return compile_spec(build_spec(plant, dt, mjcf), plant.model)


@lru_cache(maxsize=16)
def _nominal_model(
    plant: PlantSpec, known: Inertia | None, part: str, dt: float, mjcf: Mjcf
) -> mujoco.MjModel:
    """The plant, with the masses and lengths that the controller believes at key path `part`."""
    spec = build_spec(plant, dt, mjcf)
    masses = (known and known.masses) or plant.masses
    lengths = (known and known.lengths) or plant.lengths
    if (masses is None) != (lengths is None):
        raise ScenarioError(
            f"{part}: masses or lengths alone; allowed: both, or none, where plant.masses and "
            "plant.lengths are null"
        )
    if (
        masses is not None
        and lengths is not None
        and (masses, lengths)
        != (
            plant.masses,
            plant.lengths,
        )
    ):
        set_links(spec, plant.links, masses, lengths, part=part)
    return compile_spec(spec, plant.model)


class PlantView(NamedTuple):
    """The simulated robot as compiled code sees it, by address; keep its `Plant` alive."""

    model: int  # addresses
    data: int
    integrator: int
    q: Array  # (n,) rad
    qd: Array  # (n,) rad/s
    ctrl: Array  # (n,) N·m
    qacc: Array  # (n,) rad/s²


class Plant:
    """The simulated robot: M(q) q̈ + V + G = τ, stepped by MuJoCo.

    Args:
        scenario: what to build.
        mjcf: the model that it names.

    Attributes:
        q, qd: joint angle (n,) rad and velocity (n,) rad/s: live, read-only views.
        applied: torque (n,) N·m on the joints beside the motors': live, held until changed.
        model, data: MuJoCo's, this plant's own.
        view: the same robot for compiled code.
    """

    def __init__(self, scenario: Scenario, mjcf: Mjcf) -> None:
        self.model = deepcopy(_plant_model(scenario.plant, scenario.dt, mjcf))
        if self.model.nv != scenario.n_joints:
            raise ScenarioError(
                f"initial.q has {scenario.n_joints} entries; allowed: {self.model.nv}, "
                f"since plant.model = {scenario.plant.model} has {self.model.nv} joints"
            )
        data = self.data = mujoco.MjData(self.model)
        self.q: Array = _read_only(data.qpos)
        self.qd: Array = _read_only(data.qvel)
        self.applied: Array = data.qfrc_applied
        self.view = PlantView(
            model=self.model._address,
            data=data._address,
            integrator=int(self.model.opt.integrator),
            q=data.qpos,
            qd=data.qvel,
            ctrl=data.ctrl,
            qacc=data.qacc,
        )

    def reset(self, q: Array, qd: Array) -> None:
        """Put the robot at q (n,) rad, q̇ (n,) rad/s, at time zero."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = q
        self.data.qvel[:] = qd

    def state(self) -> Array:
        """Everything that the next step depends on; time, q and q̇ come first."""
        state = np.empty(mujoco.mj_stateSize(self.model, WHOLE))
        mujoco.mj_getState(self.model, self.data, state, WHOLE)
        return state

    def restore(self, state: Array) -> None:
        """Go on from a `state`; of that of a plant with other parts, only q and q̇ are taken."""
        if state.size == mujoco.mj_stateSize(self.model, WHOLE):
            mujoco.mj_setState(self.model, self.data, state, WHOLE)
        else:
            n = self.q.size
            self.reset(state[1 : 1 + n], state[1 + n : 1 + 2 * n])

    def damp(self, viscous: Array) -> None:
        """Give the joints viscous friction (n,) N·m·s/rad; every integrator takes it in."""
        self.model.dof_damping[:] = viscous

    def acceleration(self, tau: Array) -> Array:
        """True q̈ (n,) rad/s² at the present state under τ (n,) N·m: a live view."""
        forward(self.view, tau)
        return self.view.qacc

    def step(self, tau: Array) -> None:
        """Hold τ (n,) N·m for one step dt."""
        forward(self.view, tau)
        integrate(self.view)


@inner
def forward(plant: PlantView, tau: Array) -> None:
    """True q̈ at the present state under τ (n,) N·m, into `qacc`."""
    copy(tau, plant.ctrl)
    mj_forward(plant.model, plant.data)


@inner
def integrate(plant: PlantView) -> None:
    """Hold for one step the torque of the last `forward`: with it, what mj_step does."""
    if plant.integrator == RK4:
        mj_RungeKutta(plant.model, plant.data, 4)
    elif plant.integrator == EULER:
        mj_Euler(plant.model, plant.data)
    else:
        mj_implicit(plant.model, plant.data)


@inner
def solve_inertia(plant: PlantView, tau: Array, out: Array) -> None:
    """out = M(q)⁻¹ τ (n,) of the plant, at the state of the last `forward`."""
    mj_solveM(plant.model, plant.data, out.ctypes.data, tau.ctypes.data, 1)


class Nominal(NamedTuple):
    """A nominal model as compiled code sees it, by address; keep its `NominalModel` alive."""

    model: int  # addresses
    data: int
    q: Array  # (n,) rad
    qd: Array  # (n,) rad/s
    M: Array  # (n, n) kg·m², of the last `inertia`
    bias: Array  # (n,) N·m, of the last `bias`


class NominalModel:
    """What the controller believes of the robot: its own model, never the plant's data.

    Args:
        scenario: for the nominal masses and lengths, which may be set wrong.
        mjcf: the model that it names.

    Attributes:
        view: the same model for compiled code.
    """

    def __init__(self, scenario: Scenario, mjcf: Mjcf) -> None:
        believed = effectiveness(scenario.controller)
        known = believed if isinstance(believed, Inertia) else None
        inverts = inversion(scenario.controller) is not None
        part = f"controller.{'inversion.' if inverts else ''}effectiveness"
        self.model = deepcopy(_nominal_model(scenario.plant, known, part, scenario.dt, mjcf))
        data = self._data = mujoco.MjData(self.model)
        self.view = Nominal(
            model=self.model._address,
            data=data._address,
            q=data.qpos,
            qd=data.qvel,
            M=np.zeros((self.model.nv, self.model.nv)),
            bias=data.qfrc_bias,
        )

    def inertia(self, q: Array) -> Array:
        """Nominal M(q) (n, n) kg·m²; overwritten by the next call."""
        inertia(self.view, q)
        return self.view.M

    def bias(self, q: Array, qd: Array) -> Array:
        """Nominal V(q, q̇) + G(q) (n,) N·m; overwritten by the next call."""
        bias(self.view, q, qd)
        return self.view.bias


@inner
def inertia(nominal: Nominal, q: Array) -> None:
    """M(q) into `nominal.M`; of a q that is not finite, which MuJoCo never sees, no number is."""
    finite = True
    for j in range(q.size):
        nominal.q[j], finite = q[j], finite and math.isfinite(q[j])
    if finite:
        mj_kinematics(nominal.model, nominal.data)
        mj_comPos(nominal.model, nominal.data)
        mj_makeM(nominal.model, nominal.data)
        mj_fullM(nominal.model, nominal.data, nominal.M.ctypes.data)
    else:
        for j in range(q.size):
            nominal.M[j, j] = math.nan


@compiled
def bias(nominal: Nominal, q: Array, qd: Array) -> None:
    """V(q, q̇) + G(q) into `nominal.bias`; as `inertia`."""
    if not (is_finite(q) and is_finite(qd)):
        for j in range(q.size):
            nominal.bias[j] = math.nan
        return
    copy(q, nominal.q)
    copy(qd, nominal.qd)
    mj_fwdPosition(nominal.model, nominal.data)
    mj_fwdVelocity(nominal.model, nominal.data)


def _read_only(array: Array) -> Array:
    view = array.view()
    view.flags.writeable = False
    return view
