"""The robot that MuJoCo steps, and the controller's own nominal model of it.

MuJoCo is wrapped here and nowhere else on the control path: a plant is built from a scenario, takes
torques, and is read by joint angle and velocity.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from dnnmso_mj.dynamics import Links, centre_and_inertia
from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.scenario import Inertia, Scenario
from dnnmso_mj.scenario import Plant as PlantSpec

Array = np.ndarray

# MuJoCo refuses a moving body without rotational inertia; this is far below double precision.
POINT_INERTIA = 1e-14

INTEGRATORS = {
    "rk4": mujoco.mjtIntegrator.mjINT_RK4,
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}


@dataclass(frozen=True)
class Mjcf:
    """An MJCF as text without includes, and the folder that its assets are relative to."""

    text: str
    folder: str = ""

    @classmethod
    def read(cls, path: Path) -> Mjcf:
        """Read the file at `path`, its includes put in their places.

        Raises:
            ScenarioError: a file cannot be read, or one with includes is not XML.
        """
        try:
            text = path.read_text(encoding="utf-8")
            if "<include" in text:
                root = ElementTree.fromstring(text)  # noqa: S314
                _put_in_includes(root, path.parent)
                text = ElementTree.tostring(root, encoding="unicode")
        except (OSError, UnicodeDecodeError, ElementTree.ParseError, RecursionError) as error:
            raise ScenarioError(f"plant.model: cannot read {path}: {error}") from error
        return cls(text, str(path.parent))


def _put_in_includes(element: ElementTree.Element, folder: Path) -> None:
    """Replace each <include file="…"/> by what stands in that file; paths are from `folder`."""
    for place, child in reversed(list(enumerate(element))):
        if child.tag == "include":
            part = ElementTree.parse(folder / child.get("file", "")).getroot()  # noqa: S314
            _put_in_includes(part, folder)
            element[place : place + 1] = list(part)
        else:
            _put_in_includes(child, folder)


def build_spec(plant: PlantSpec, dt: float, mjcf: Mjcf) -> mujoco.MjSpec:
    """Give an MJCF the scenario's masses, lengths, gravity and step.

    Raises:
        ScenarioError: MuJoCo cannot read the file, or it lacks the bodies link1 … linkn that
            masses and lengths are set on.
    """
    try:
        spec = mujoco.MjSpec.from_string(mjcf.text)
    except ValueError as error:
        raise ScenarioError(f"plant.model = {plant.model}: MuJoCo says: {error}") from error
    spec.modelfiledir = mjcf.folder
    spec.option.timestep = dt
    spec.option.gravity = [0.0, 0.0, -plant.gravity]
    spec.option.integrator = INTEGRATORS[plant.integrator]
    # Without this MuJoCo answers a NaN by moving the arm back to its start, silently.
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    if plant.masses is not None and plant.lengths is not None:
        set_links(spec, plant.links, plant.masses, plant.lengths)
    return spec


def set_links(
    spec: mujoco.MjSpec, links: Links, masses: tuple[float, ...], lengths: tuple[float, ...]
) -> None:
    """Give bodies link1 … linkn of a chain along x their masses (kg) and lengths (m)."""
    for k, (mass, length) in enumerate(zip(masses, lengths, strict=True), start=1):
        body = spec.body(f"link{k}")
        if body is None:
            names = ", ".join(b.name for b in spec.bodies[1:])
            raise ScenarioError(
                f"plant.masses has {len(masses)} entries, but the model has no body 'link{k}' "
                f"(it has: {names}). Allowed: bodies link1 to link{len(masses)}, or null masses "
                "and lengths to keep what the MJCF says."
            )
        centre, inertia = centre_and_inertia(links, mass, length)
        body.mass = mass
        body.ipos = [centre, 0.0, 0.0]
        # A thin rod along x: no inertia about its own axis.
        body.inertia = [POINT_INERTIA, max(inertia, POINT_INERTIA), max(inertia, POINT_INERTIA)]
        body.explicitinertial = 1
        for child in body.bodies:
            child.pos = [length, 0.0, 0.0]
        for geom in body.geoms:
            if geom.type == mujoco.mjtGeom.mjGEOM_CAPSULE:
                geom.fromto = [0.0, 0.0, 0.0, length, 0.0, 0.0]
            else:
                geom.pos = [length, 0.0, 0.0]
        for site in body.sites:
            site.pos = [length, 0.0, 0.0]


def compile_spec(spec: mujoco.MjSpec, name: str) -> mujoco.MjModel:
    """Compile, and refuse what the testbed cannot drive: other joints, other actuators.

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
    return model


class Plant:
    """The simulated robot: M(q) q̈ + V + G = τ, stepped by MuJoCo.

    Args:
        scenario: what to build.
        mjcf: the model that it names.

    Attributes:
        q, qd: joint angle (n,) rad and velocity (n,) rad/s: live, read-only views.
        model: MuJoCo's model.
    """

    def __init__(self, scenario: Scenario, mjcf: Mjcf) -> None:
        spec = build_spec(scenario.plant, scenario.dt, mjcf)
        self.model = compile_spec(spec, scenario.plant.model)
        if self.model.nv != scenario.n_joints:
            raise ScenarioError(
                f"initial.q has {scenario.n_joints} entries; allowed: {self.model.nv}, "
                f"since plant.model = {scenario.plant.model} has {self.model.nv} joints"
            )
        self._data = mujoco.MjData(self.model)
        self.q: Array = _read_only(self._data.qpos)
        self.qd: Array = _read_only(self._data.qvel)
        self._ctrl: Array = self._data.ctrl
        self._qacc: Array = self._data.qacc

    def reset(self, q: Array, qd: Array) -> None:
        """Put the robot at q (n,) rad, q̇ (n,) rad/s, at time zero."""
        mujoco.mj_resetData(self.model, self._data)
        self._data.qpos[:] = q
        self._data.qvel[:] = qd

    def acceleration(self, tau: Array) -> Array:
        """True q̈ (n,) rad/s² at the present state under τ (n,) N·m: a live view."""
        self._ctrl[:] = tau
        mujoco.mj_forward(self.model, self._data)
        return self._qacc

    def step(self, tau: Array) -> None:
        """Hold τ (n,) N·m for one step dt."""
        self._ctrl[:] = tau
        mujoco.mj_step(self.model, self._data)


class NominalModel:
    """What the controller believes of the robot: its own model, never the plant's data.

    Args:
        scenario: for the nominal masses and lengths, which may be set wrong.
        mjcf: the model that it names.
    """

    def __init__(self, scenario: Scenario, mjcf: Mjcf) -> None:
        effectiveness = scenario.controller.inversion.effectiveness
        spec = build_spec(scenario.plant, scenario.dt, mjcf)
        if isinstance(effectiveness, Inertia):
            masses = effectiveness.masses or scenario.plant.masses
            lengths = effectiveness.lengths or scenario.plant.lengths
            if (masses is None) != (lengths is None):
                raise ScenarioError(
                    "controller.inversion.effectiveness: masses or lengths alone; allowed: both, "
                    "or none, where plant.masses and plant.lengths are null"
                )
            if masses is not None and lengths is not None:
                set_links(spec, scenario.plant.links, masses, lengths)
        self.model = compile_spec(spec, scenario.plant.model)
        self._data = mujoco.MjData(self.model)
        self._M: Array = np.zeros((self.model.nv, self.model.nv))
        self._qfrc_bias: Array = self._data.qfrc_bias

    def inertia(self, q: Array) -> Array:
        """Nominal M(q) (n, n) kg·m²; overwritten by the next call."""
        self._data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_comPos(self.model, self._data)
        mujoco.mj_makeM(self.model, self._data)
        mujoco.mj_fullM(self.model, self._data, self._M)
        return self._M

    def bias(self, q: Array, qd: Array) -> Array:
        """Nominal V(q, q̇) + G(q) (n,) N·m; overwritten by the next call."""
        self._data.qpos[:] = q
        self._data.qvel[:] = qd
        mujoco.mj_fwdPosition(self.model, self._data)
        mujoco.mj_fwdVelocity(self.model, self._data)
        return self._qfrc_bias


def _read_only(array: Array) -> Array:
    view = array.view()
    view.flags.writeable = False
    return view
