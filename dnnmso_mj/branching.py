"""From the state of one scenario's run to that of another's: what fits is kept."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dnnmso_mj.scenario import External, Policy, Scenario, expand
from dnnmso_mj.scenario.controller import inversion
from dnnmso_mj.simulation import Simulation
from dnnmso_mj.theory import UNDEFINED, TrackingBounds, start_bounds
from dnnmso_mj.world_state import EXTERNAL, State

Array = np.ndarray


def branch(state: State, before: Scenario, simulation: Simulation) -> tuple[State, str]:
    """Go on in another scenario with the state that a run was in.

    The arm keeps q and q̇. A controller of the same kind keeps its state where all its arrays have
    the shapes that they had; any other begins anew with the present reading. Delays keep the newest
    of what is on its way, and go on from the oldest where they have become longer; a lower torque
    limit holds for it at once. Imperfections from outside go on where they are the same code.
    Bounds begin anew where the reference or the law that they are of is another.

    Args:
        state: of the run so far.
        before: its scenario.
        simulation: of the scenario to go on in.

    Returns:
        The state to start `simulation` in, and in words what became of the controller.
    """
    simulation.begin()
    fresh, now = simulation.state(), simulation.scenario
    why = _why_anew(state, fresh, before, now)
    world = dict(state.world)
    for name in ("actuators_past", "sensors_past"):
        world[name] = _refill(world[name], len(fresh.world[name]), state.tick)
    limit = now.imperfections.torque_limit
    if limit is not None:
        most = expand(limit, now.n_joints)
        for name in ("actuators_past", "actuators_held"):
            world[name] = np.clip(world[name], -most, most)
    codes = [[part.python for part in each.imperfections.external] for each in (before, now)]
    if codes[0] != codes[1]:
        kept = {name: values for name, values in world.items() if not name.startswith(EXTERNAL)}
        world = kept | {n: v for n, v in fresh.world.items() if n.startswith(EXTERNAL)}
    bounded = (inversion(now.controller), now.reference)
    anew = bounded != (inversion(before.controller), before.reference)
    if anew:
        world |= {name: fresh.world[name] for name in world if name.startswith("bounds_")}
    simulation.begin(State(state.tick, None if why else state.controller, world))
    if anew:
        _start_bounds(simulation, state.tick)
    told = f"the controller begins anew: {why}" if why else "the controller goes on as it is"
    return simulation.state(), told


def misfit(found: Mapping[str, Array] | None, expected: Mapping[str, Array] | None) -> str:
    """The first array that is missing, too many or of another shape, in words; "" if all fit."""
    found, expected = found or {}, expected or {}
    for name in sorted({*found, *expected}):
        if name not in found or name not in expected:
            return f"its state has {'no' if name in expected else 'too much:'} {name}"
        if found[name].shape != expected[name].shape:
            return f"{name} had {found[name].shape} entries and has {expected[name].shape}"
        if found[name].dtype != expected[name].dtype:
            return f"{name} was of type {found[name].dtype} and is {expected[name].dtype}"
    return ""


def code_of(scenario: Scenario) -> str:
    """What a controller from outside is made of, which may keep what it likes; else ""."""
    match scenario.controller:
        case External(python=python):
            return python
        case Policy(python=python, sha256=sha256):
            return python or sha256 or ""
    return ""


def _why_anew(state: State, fresh: State, before: Scenario, now: Scenario) -> str:
    kinds = before.controller.kind, now.controller.kind
    if kinds[0] != kinds[1]:
        return f"it was {kinds[0]}, and is {kinds[1]}"
    codes = code_of(before), code_of(now)
    if codes[0]:
        return "" if codes[0] == codes[1] else f"it was {codes[0]}, and is {codes[1]}"
    return misfit(state.controller, fresh.controller)


def _refill(ring: Array, size: int, tick: int) -> Array:
    """A ring of another size with the same past: entry k % size is that of tick k."""
    ticks = np.arange(tick - size, tick)
    filled = np.empty((size, *ring.shape[1:]))
    filled[ticks % size] = ring[np.maximum(ticks, tick - len(ring)) % len(ring)]
    return filled


def _start_bounds(simulation: Simulation, tick: int) -> None:
    """Begin at the present error; the next tick, ending a period that had no bounds, adds to it."""
    plant, bounds = simulation.plant, simulation.stage.world.bounds
    q_ref, qd_ref, _ = simulation.stage.reference.sample(np.array([tick * simulation.scenario.dt]))
    error = np.concatenate([plant.q, plant.qd]) - np.concatenate([q_ref[0], qd_ref[0]])
    start_bounds(bounds, error)
    _undo_decay(bounds)


def _undo_decay(bounds: TrackingBounds) -> None:
    for value, (decay, _) in zip((bounds.s, bounds.joint, bounds.paper), bounds.holds, strict=True):
        if value[0] != UNDEFINED:
            value[0] /= decay
    bounds.norms[:] = 0.0
