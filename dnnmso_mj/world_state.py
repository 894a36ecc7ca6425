"""The state that a run is in between two ticks: enough to go on from, to the last bit.

What a scenario makes anew is not in it: the reference, the random numbers, and what its events have
changed by then.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dnnmso_mj.external.imperfection import Hooks
from dnnmso_mj.imperfections.actuators import GIVEN, LAGGED
from dnnmso_mj.plant import Plant
from dnnmso_mj.safety import Q_STOP
from dnnmso_mj.tick import World

Array = np.ndarray

EXTERNAL = "external."  # begins the names of what imperfections from outside keep


class State(NamedTuple):
    """A run before one of its ticks."""

    tick: int
    controller: Mapping[str, Array] | None  # its `state()`; None: it begins at this tick
    world: Mapping[str, Array]  # see `capture`


def capture(world: World, plant: Plant, hooks: Hooks, flags: Array) -> dict[str, Array]:
    """What the next tick depends on beside the controller, as copies.

    Drives and sensors without delay keep no past; it is filled in as what they have at present, so
    that a run with other imperfections can begin with it.

    Args:
        world, plant, hooks: between two ticks.
        flags: which of the changes that make an event are in force.

    Returns:
        plant: MuJoCo's state: time, q (n,) rad, q̇ (n,) rad/s, and the torques beside the motors'.
        tau: (n,) N·m, applied in the last period.
        actuators_held, actuators_past: what is in the drives; see `Actuators`.
        loads_held: torques (2, n) N·m beside the motors' in the last period; see `Loads`.
        sensors_past, sensors_last: true states and the last reading; see `Sensors`.
        bounds_…: of the tracking error, and what they are integrated with; see `TrackingBounds`.
        flags: as given.
        safety_ticks, safety_state: of a safe stop, where the scenario has limits; see `Safety`.
        external.…: what imperfections from outside keep.
    """
    actuators, sensors, bounds = world.actuators, world.sensors, world.bounds
    kept = {
        "plant": plant.state(),
        "tau": world.tau,
        "actuators_held": actuators.held,
        "actuators_past": actuators.past,
        "loads_held": world.loads.held,
        "sensors_past": sensors.past,
        "sensors_last": sensors.last,
        **{f"bounds_{name}": getattr(bounds, name) for name in _BOUNDS},
        "flags": flags,
        **{f"{EXTERNAL}{name}": values for name, values in hooks.state().items()},
    }
    if world.safety.guards:
        kept["safety_ticks"] = world.safety.ticks
        kept["safety_state"] = world.safety.limits[Q_STOP:]
    state = {name: np.array(values) for name, values in kept.items()}
    if actuators.prompt:
        state["actuators_held"][LAGGED] = state["actuators_past"][:] = actuators.held[GIVEN]
    if sensors.perfect:
        before = plant.q - world.dt * plant.qd
        state["sensors_past"][:] = np.concatenate([plant.q, plant.qd])
        state["sensors_last"][:] = np.concatenate([before, plant.qd])
    return state


def restore(world: World, plant: Plant, hooks: Hooks, state: Mapping[str, Array]) -> None:
    """Put back what `capture` gave, but for the flags."""
    plant.restore(state["plant"])
    world.tau[:] = state["tau"]
    world.actuators.held[:] = state["actuators_held"]
    world.actuators.past[:] = state["actuators_past"]
    world.loads.held[:] = state["loads_held"]
    world.sensors.past[:] = state["sensors_past"]
    world.sensors.last[:] = state["sensors_last"]
    for name in _BOUNDS:
        getattr(world.bounds, name)[:] = state[f"bounds_{name}"]
    if world.safety.guards and "safety_ticks" in state:
        world.safety.ticks[:] = state["safety_ticks"]
        world.safety.limits[Q_STOP:] = state["safety_state"]
    outside = {n.removeprefix(EXTERNAL): v for n, v in state.items() if n.startswith(EXTERNAL)}
    if hooks:
        hooks.restore(outside)


_BOUNDS = ("joint", "paper", "s", "norms", "qdd")
