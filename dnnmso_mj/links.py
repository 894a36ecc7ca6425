"""A scenario's masses and lengths, put on the bodies link1 … linkn of an MJCF.

This works for a chain along +x alone: each link's frame stands at its joint, and the next link's at
its tip, turned by nothing but the joints. Any other model is refused rather than bent.
"""

from __future__ import annotations

from itertools import pairwise

import mujoco
import numpy as np

from dnnmso_mj.dynamics import Links, centre_and_inertia
from dnnmso_mj.errors import ScenarioError

# MuJoCo refuses a moving body without rotational inertia; this is far below double precision.
POINT_INERTIA = 1e-14

SLACK = 1e-9

ALLOWED = (
    "a chain of bodies link1, link2, … along +x, each on the tip of the one before and not turned, "
    "or null masses and lengths, which keep what the MJCF says"
)


def set_links(
    spec: mujoco.MjSpec,
    links: Links,
    masses: tuple[float, ...],
    lengths: tuple[float, ...],
    part: str = "plant",
) -> None:
    """Give bodies link1 … linkn of a chain along +x their masses (kg) and lengths (m).

    A spec that MuJoCo cannot compile is left as it is, for `compile_spec` to tell what is wrong.

    Args:
        spec: the model, changed in place.
        links: "point_mass" at each tip, or uniform thin "rod".
        masses: kg, one for each link.
        lengths: m, one for each link.
        part: of the scenario that they come from, for messages.

    Raises:
        ScenarioError: the model is not such a chain, or its <compiler> overrules the masses; names
            the body.
    """
    try:
        _set_links(spec, links, masses, lengths)
    except ScenarioError as error:
        raise ScenarioError(
            f"{part}.masses and {part}.lengths: {error}; allowed: {ALLOWED}"
        ) from error


def _set_links(
    spec: mujoco.MjSpec, links: Links, masses: tuple[float, ...], lengths: tuple[float, ...]
) -> None:
    bodies = _bodies(spec, len(masses))
    try:
        before = spec.compile()
        for body in bodies:
            _refuse_bent(before, body)
        for body, mass, length in zip(bodies, masses, lengths, strict=True):
            _set_link(body, links, mass, length)
        after = spec.compile()
    except ValueError:
        return
    for body, mass in zip(bodies, masses, strict=True):
        _hold_to(after, body, mass)


def _bodies(spec: mujoco.MjSpec, n: int) -> list[mujoco.MjsBody]:
    """Bodies link1 … linkn, each the only child of the one before."""
    bodies = [spec.body(f"link{k}") for k in range(1, n + 1)]
    for k, body in enumerate(bodies, start=1):
        if body is None:
            names = ", ".join(b.name for b in spec.bodies[1:])
            raise ScenarioError(f"the model has no body 'link{k}' (it has: {names})")
    for body, following in pairwise([*bodies, None]):
        children = [child.name for child in body.bodies]
        if len(children) > 1:
            raise _misfit(body, f"carries {len(children)} bodies ({', '.join(children)})")
        if following is not None and children != [following.name]:
            raise _misfit(following, f"does not stand on body '{body.name}'")
    return bodies


def _refuse_bent(model: mujoco.MjModel, body: mujoco.MjsBody) -> None:
    """Refuse a joint away from the link's frame, or something at its tip that is not along +x."""
    for joint in body.joints:
        if model.jnt_pos[joint.id].any():
            raise _misfit(body, f"has its joint '{joint.name}' away from its origin")
    for child in body.bodies:
        x, y, z = model.body_pos[child.id]
        if not (x > 0 and abs(y) <= SLACK * x and abs(z) <= SLACK * x):
            raise _misfit(child, f"stands at ({x:.4g}, {y:.4g}, {z:.4g}), not along +x")
        if np.abs(model.body_quat[child.id][1:]).max() > SLACK:
            raise _misfit(child, f"is turned against body '{body.name}'")


def _set_link(body: mujoco.MjsBody, links: Links, mass: float, length: float) -> None:
    centre, inertia = centre_and_inertia(links, mass, length)
    body.mass = mass
    body.ipos = [centre, 0.0, 0.0]
    # A thin rod along x: no inertia about its own axis.
    body.inertia = [POINT_INERTIA, max(inertia, POINT_INERTIA), max(inertia, POINT_INERTIA)]
    body.iquat = [1.0, 0.0, 0.0, 0.0]
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.fullinertia = [np.nan] * 6
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


def _hold_to(model: mujoco.MjModel, body: mujoco.MjsBody, mass: float) -> None:
    """Refuse a model whose <compiler>, or a <frame>, makes something else of what was set."""
    found = model.body_mass[body.id]
    if abs(found - mass) > SLACK * mass or model.body_ipos[body.id].tolist() != list(body.ipos):
        raise ScenarioError(
            f"body '{body.name}' is set to {mass:g} kg, but MuJoCo makes {found:.4g} kg of it, or "
            "moves it, as <compiler> says (inertiafromgeom, settotalmass, boundmass)"
        )
    inertia = max(model.body_inertia[body.id])
    if inertia > max(body.inertia) * (1 + SLACK):
        raise ScenarioError(
            f"body '{body.name}' gets {inertia:.4g} kg·m² from MuJoCo, as <compiler> says "
            "(boundinertia)"
        )
    for child in body.bodies:
        if not np.allclose(model.body_pos[child.id], child.pos, rtol=0, atol=SLACK):
            raise _misfit(child, "stands in a <frame>")


def _misfit(body: mujoco.MjsBody, what: str) -> ScenarioError:
    return ScenarioError(f"body '{body.name}' {what}")
