"""References from outside: a function of times, checked before the arm follows it.

def swing(t, size=1.0):
    q = size * np.sin(t)[:, None] * [1.0, 0.5]  # (T, 2)
    ...
    return q, qd, qdd
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dnnmso_mj.errors import ExternalError
from dnnmso_mj.external import called, import_callable
from dnnmso_mj.scenario import ExternalReference
from dnnmso_mj.wording import show

Array = np.ndarray
Samples = tuple[Array, Array, Array]

GROUP = "dnnmso_mj.references"
KEY = "reference.python"

CHECKED = 400  # times at which derivatives are held against differences
STEP = 1e-6  # s
TOLERANCE = 1e-3  # of the largest value
NAMES = ("q", "qd", "qdd")
UNITS = ("rad", "rad/s", "rad/s²")


def external_reference(
    spec: ExternalReference, n_joints: int, span: float
) -> Callable[[Array], Samples]:
    """The function that a scenario names, its answers checked.

    Args:
        spec: the function, and its arguments but the first.
        n_joints: n.
        span: until when (s) its derivatives are checked.

    Raises:
        ScenarioError: it cannot be imported.
        ExternalError: it fails, gives other shapes or what is not finite, or q̇, q̈ are not the
            derivatives; where it does so at a later time, from `sample`.
    """
    function = import_callable(spec.python, KEY, GROUP)
    who = f"{KEY} = {show(spec.python)}"

    def sample(t: Array) -> Samples:
        with called(who):
            found = function(t.copy(), **spec.settings)
        return _checked(found, t, n_joints, who)

    _check_derivatives(sample, span, who)
    return sample


def _checked(found: Any, t: Array, n: int, who: str) -> Samples:
    if not isinstance(found, tuple | list) or len(found) != 3:
        raise ExternalError(f"{who} gives {type(found).__name__}; allowed: q, qd, qdd")
    shape, arrays = (t.size, n), []
    for name, unit, values in zip(NAMES, UNITS, found, strict=True):
        with called(who):
            array = np.asarray(values, dtype=float)
        if array.shape != shape:
            raise ExternalError(
                f"{who} gives {name} of shape {array.shape} at {t.size} times; allowed: {shape}, "
                f"one row a time, one column a joint ({unit})"
            )
        bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
        if bad.size:
            raise ExternalError(
                f"{who} gives {name} = {show(array[bad[0]].tolist())} at t = {t[bad[0]]:g} s; "
                "allowed: finite numbers"
            )
        arrays.append(array)
    return arrays[0], arrays[1], arrays[2]


def _check_derivatives(sample: Callable[[Array], Samples], span: float, who: str) -> None:
    """Hold q̇ and q̈ against differences; at a corner either side's will do."""
    t = span * (np.arange(CHECKED) + 0.618) / CHECKED
    before, here, after = sample(np.maximum(t - STEP, 0.0)), sample(t), sample(t + STEP)
    since = (t - np.maximum(t - STEP, 0.0))[:, None]
    for k in (1, 2):
        forward = (after[k - 1] - here[k - 1]) / STEP
        backward = (here[k - 1] - before[k - 1]) / since
        off = np.minimum(abs(forward - here[k]), abs(backward - here[k]))  # (T, n)
        # Differences of what has this size are rounded to about as much.
        rounding = 1e-15 * (1.0 + abs(here[k - 1]).max()) / STEP
        allowed = TOLERANCE * max(abs(here[k]).max(), abs(forward).max()) + 100 * rounding
        if (off > allowed).any():
            i, joint = np.unravel_index(int(np.argmax(off)), off.shape)
            raise ExternalError(
                f"{who}: {NAMES[k]} is not the derivative of {NAMES[k - 1]}: at t = {t[i]:.6g} s "
                f"joint {joint + 1} has {NAMES[k]} = {here[k][i, joint]:.6g} {UNITS[k]}, and "
                f"{NAMES[k - 1]} changes by {forward[i, joint]:.6g} {UNITS[k]}"
            )
