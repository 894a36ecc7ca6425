"""Why a run ends before its time: which quantity a tick found wrong."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dnnmso_mj.errors import NonFiniteError
from dnnmso_mj.tick import (
    DIVERGED_ABOVE,
    MISSED,
    MUJOCO_ZEROES_ABOVE,
    OUT_OF_RANGE,
    ROWS,
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
        world: whose status is not RUNNING.
        layout: of its rows.
    """
    counts = world.counts
    tau = world.actuators.tau.tolist()
    name = "the watchdog's tau" if counts[MISSED] else "tau"
    if counts[STATUS] == TAU_NOT_FINITE:
        return NonFiniteError(name, tau)
    if counts[STATUS] == TAU_TOO_LARGE:
        return NonFiniteError(name, f"{tau}, above {MUJOCO_ZEROES_ABOVE:g}")
    recorded = counts[STATUS] == OUT_OF_RANGE  # the other rows are left out
    row = world.rows[counts[ROWS] - int(recorded)]
    fields = {name: row[where] for name, where in layout.slices.items()}
    if recorded:
        largest = {name: float(np.abs(fields[name]).max()) for name in ("q", "qd", "x_hat")}
        name = next(name for name, value in largest.items() if value > DIVERGED_ABOVE)
        return NonFiniteError(f"|{name}|", f"{largest[name]:.4g}, above {DIVERGED_ABOVE:g}")
    name = next(name for name, values in fields.items() if not np.isfinite(values).all())
    return NonFiniteError(name, fields[name].tolist())


def not_finite(state: Mapping[str, Array]) -> list[str]:
    """Names of the arrays of numbers with one that is not finite."""
    return [
        name
        for name, values in state.items()
        if values.dtype.kind not in "SU" and not np.isfinite(values).all()
    ]
