"""What an MJCF may hold that M(q) q̈ + V + G = τ does not: refused, for it would falsify a run.

The controller's B, the true f̃ and the bounds are all made from M, V, G and the joint torque. A
force that is none of these (damping, a spring, a limit, a contact) would be counted as something
that the network failed to learn. Armature is part of MuJoCo's M, and so allowed.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from dnnmso_mj.errors import ScenarioError

Array = np.ndarray
Disable = mujoco.mjtDisableBit

MAX_TOLD = 5


def refuse_unmodelled(model: mujoco.MjModel, name: str) -> None:
    """Refuse a model in which anything but inertia, gravity and motors acts on the joints.

    Raises:
        ScenarioError: naming the elements, and what to write instead.
    """
    found = list(_unmodelled(model))
    if found:
        told = "; ".join(found[:MAX_TOLD])
        more = f"; … and {len(found) - MAX_TOLD} more" if len(found) > MAX_TOLD else ""
        raise ScenarioError(
            f"plant.model = {name}: {told}{more}. Allowed: rigid bodies, gravity and motors, since "
            "the controller and its theory know no other forces"
        )


def _unmodelled(model: mujoco.MjModel) -> Iterator[str]:
    yield from _joint_forces(model)
    yield from _motor_limits(model)
    yield from _tendons(model)
    if _on(model, Disable.mjDSBL_CONSTRAINT):
        yield from _constraints(model)
    for body in np.flatnonzero(model.body_gravcomp):
        yield f'body {_name(model.body(body))} has gravcomp; set gravcomp="0"'
    if model.opt.density or model.opt.viscosity:
        yield 'the option density or viscosity makes drag; set both to "0"'
    if model.nflex or model.nplugin:
        yield "it has a flex or a plugin; remove it"
    for flag in ("GRAVITY", "ACTUATION"):
        if not _on(model, getattr(Disable, f"mjDSBL_{flag}")):
            word = flag.lower()
            yield f'<flag {word}="disable"> switches off {word}; set {word}="enable"'
    if model.opt.disableactuator:
        yield "the option actuatorgroupdisable switches off motors; remove it"
    if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        yield '<flag sleep="enable"> stops bodies at rest; remove it'


def _on(model: mujoco.MjModel, flag: mujoco.mjtDisableBit) -> bool:
    return not model.opt.disableflags & flag


def _name(element: Any) -> str:
    return f"'{element.name}'" if element.name else f"{element.id} (without a name)"


def _joint_forces(model: mujoco.MjModel) -> Iterator[str]:
    """Passive forces and friction."""
    springs, dampers = (_on(model, getattr(Disable, f"mjDSBL_{x}")) for x in ("SPRING", "DAMPER"))
    dry = _on(model, Disable.mjDSBL_FRICTIONLOSS) and _on(model, Disable.mjDSBL_CONSTRAINT)
    kinds = {
        "damping": dampers & _any(model.dof_damping, model.dof_dampingpoly),
        "frictionloss": dry & (model.dof_frictionloss != 0),
        "stiffness": springs & _any(model.jnt_stiffness, model.jnt_stiffnesspoly),
    }
    for kind, has in kinds.items():
        for joint in np.flatnonzero(has):
            yield f'joint {_name(model.joint(joint))} has {kind}; set {kind}="0"'


def _any(first: Array, rest: Array) -> Array:
    """Which rows have a coefficient: the linear one, or one of a polynomial."""
    has: Array = (first != 0) | (rest != 0).any(axis=1)
    return has


def _motor_limits(model: mujoco.MjModel) -> Iterator[str]:
    """Torques between the scenario's limit and the joint."""
    for joint in np.flatnonzero(model.jnt_actfrclimited):
        yield (
            f"joint {_name(model.joint(joint))} has actuatorfrcrange; remove it (torque limits "
            "belong to the scenario: imperfections.torque_limit)"
        )
    for motor in np.flatnonzero(model.actuator_forcelimited):
        yield (
            f"motor {_name(model.actuator(motor))} has forcerange; remove it (torque limits "
            "belong to the scenario: imperfections.torque_limit)"
        )
    damped = _any(model.actuator_damping, model.actuator_dampingpoly) | (model.actuator_delay != 0)
    for motor in np.flatnonzero(damped):
        yield f"motor {_name(model.actuator(motor))} has damping or a delay; remove it"


def _tendons(model: mujoco.MjModel) -> Iterator[str]:
    """A tendon that only measures is allowed; its limits and friction are constraints."""
    acts = _any(model.tendon_stiffness, model.tendon_stiffnesspoly)
    acts |= _any(model.tendon_damping, model.tendon_dampingpoly)
    acts |= (model.tendon_armature != 0) | (model.tendon_frictionloss != 0)
    acts |= model.tendon_limited != 0
    for tendon in np.flatnonzero(acts):
        yield (
            f"tendon {_name(model.tendon(tendon))} has stiffness, damping, armature, frictionloss "
            "or a range; remove it"
        )


def _constraints(model: mujoco.MjModel) -> Iterator[str]:
    if _on(model, Disable.mjDSBL_LIMIT):
        for joint in np.flatnonzero(model.jnt_limited):
            yield (
                f'joint {_name(model.joint(joint))} has a range; set limited="false", or '
                '<flag limit="disable"/> in <option>'
            )
    if _on(model, Disable.mjDSBL_EQUALITY):
        for k in np.flatnonzero(model.eq_active0):
            yield f"equality {_name(model.equality(k))} is active; remove it"
    if _on(model, Disable.mjDSBL_CONTACT):
        pair = _colliding(model)
        if pair is not None:
            first, second = (_name(model.geom(geom)) for geom in pair)
            yield (
                f'geoms {first} and {second} can touch; set contype="0" and conaffinity="0", or '
                '<flag contact="disable"/> in <option>'
            )


def _colliding(model: mujoco.MjModel) -> tuple[int, int] | None:
    """Two geoms that MuJoCo would let collide, if there are such: its filters, for all pairs."""
    if model.npair:
        return int(model.pair_geom1[0]), int(model.pair_geom2[0])
    body = model.geom_bodyid
    moves = model.body_weldid[body]  # 0 where the geom is fixed to the world
    above = model.body_weldid[model.body_parentid[moves]]
    bits = model.geom_contype[:, None] & model.geom_conaffinity[None, :]
    touch = ((bits | bits.T) != 0) & (moves[:, None] != moves[None, :])
    if _on(model, Disable.mjDSBL_FILTERPARENT):
        family = (above[:, None] == moves[None, :]) & (moves[None, :] != 0)
        touch &= ~(family | family.T)
    codes = (body[:, None] << 16) + body[None, :]
    touch &= ~np.isin(codes, model.exclude_signature) & ~np.isin(codes.T, model.exclude_signature)
    pairs = np.argwhere(touch)
    return (int(pairs[0, 0]), int(pairs[0, 1])) if len(pairs) else None
