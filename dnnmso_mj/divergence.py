"""Why a run ends before its time: which quantity a tick found wrong."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dnnmso_mj.errors import NonFiniteError
from dnnmso_mj.tick import (
    DIVERGED_ABOVE,
    LOAD_TOO_LARGE,
    MISSED,
    MUJOCO_ZEROES_ABOVE,
    QDD_ABOVE,
    READING_NOT_FINITE,
    ROW_NOT_FINITE,
    ROWS,
    STATE_NOT_FINITE,
    STATUS,
    TAU_NOT_FINITE,
    TAU_TOO_LARGE,
    World,
)
from dnnmso_mj.trace import StepLayout

Array = np.ndarray


def why_it_ended(world: World, layout: StepLayout) -> NonFiniteError:
    """The quantity that a tick found wrong, and its value.

    Args:
        world: whose status is neither RUNNING nor SAFELY_STOPPED.
        layout: of its rows.
    """
    far = far_state(world)
    if far is not None:
        return far
    status, above = world.counts[STATUS], f"above {MUJOCO_ZEROES_ABOVE:g}"
    if status in {TAU_NOT_FINITE, TAU_TOO_LARGE}:
        name, tau = "the watchdog's tau" if world.counts[MISSED] else "tau", world.actuators.tau
        large = f", {above}" if status == TAU_TOO_LARGE else ""
        return NonFiniteError(name, f"{tau.tolist()}{large}")
    if status == LOAD_TOO_LARGE:
        return NonFiniteError(
            "torque beside the motors'", f"{world.loads.torque.tolist()}, {above}"
        )
    if status in {STATE_NOT_FINITE, READING_NOT_FINITE}:
        return _of_state(world)
    return _of_row(world, layout)


def _told(world: World) -> dict[str, Array]:
    q_meas, qd_meas = np.split(world.inputs.x, 2)
    return {"q": world.plant.q, "qd": world.plant.qd, "q_meas": q_meas, "qd_meas": qd_meas}


def far_state(world: World) -> NonFiniteError | None:
    """A true state, or else a reading, where no arm is: all else that is wrong comes of it."""
    for name, values in _told(world).items():
        largest = float(np.abs(values).max())
        if DIVERGED_ABOVE < largest < np.inf:
            return NonFiniteError(f"|{name}|", f"{largest:.4g}, above {DIVERGED_ABOVE:g}")
    return None


def _of_state(world: World) -> NonFiniteError:
    """The angles or velocities that are no numbers, true ones before readings."""
    named = _told(world)
    name = next(name for name, values in named.items() if not np.isfinite(values).all())
    return NonFiniteError(name, named[name].tolist())


def _of_row(world: World, layout: StepLayout) -> NonFiniteError:
    """What is wrong with a whole row; one that is not finite was left out."""
    counts = world.counts
    left_out = counts[STATUS] == ROW_NOT_FINITE
    row = world.rows[counts[ROWS] - int(not left_out)]
    fields = {name: row[where] for name, where in layout.slices.items()}
    for name, values, most in (
        ("x_hat", fields["x_hat"], DIVERGED_ABOVE),
        ("qdd", world.plant.qacc, QDD_ABOVE),
    ):
        largest = float(np.abs(values).max())
        if most < largest < np.inf:
            return NonFiniteError(f"|{name}|", f"{largest:.4g}, above {most:g}")
    name = next(name for name, values in fields.items() if not np.isfinite(values).all())
    return NonFiniteError(name, fields[name].tolist())


def not_finite(state: Mapping[str, Array]) -> list[str]:
    """Names of the arrays of numbers with one that is not finite."""
    return [
        name
        for name, values in state.items()
        if values.dtype.kind not in "SU" and not np.isfinite(values).all()
    ]
