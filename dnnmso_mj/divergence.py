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
    status, tau = world.counts[STATUS], world.actuators.tau.tolist()
    name = "the watchdog's tau" if world.counts[MISSED] else "tau"
    if status == TAU_NOT_FINITE:
        return NonFiniteError(name, tau)
    if status == TAU_TOO_LARGE:
        return NonFiniteError(name, f"{tau}, above {MUJOCO_ZEROES_ABOVE:g}")
    if status == LOAD_TOO_LARGE:
        torque = world.loads.torque.tolist()
        return NonFiniteError(
            "torque beside the motors'", f"{torque}, above {MUJOCO_ZEROES_ABOVE:g}"
        )
    if status == STATE_NOT_FINITE:
        return _of_state(np.concatenate([world.plant.q, world.plant.qd]), "")
    if status == READING_NOT_FINITE:
        return _of_state(world.inputs.x, "_meas")
    return _of_row(world, layout)


def _of_state(x: Array, suffix: str) -> NonFiniteError:
    q, qd = np.split(x, 2)
    name, values = ("qd", qd) if np.isfinite(q).all() else ("q", q)
    return NonFiniteError(name + suffix, values.tolist())


def _of_row(world: World, layout: StepLayout) -> NonFiniteError:
    """What is wrong with a whole row; one that is not finite was left out."""
    counts = world.counts
    left_out = counts[STATUS] == ROW_NOT_FINITE
    row = world.rows[counts[ROWS] - int(not left_out)]
    fields = {name: row[where] for name, where in layout.slices.items()}
    for name, values, most in (
        *((name, fields[name], DIVERGED_ABOVE) for name in ("q", "qd", "x_hat")),
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
