"""What a frozen model looks like: maps of true and learned dynamics, and both along the visit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dnnmso_mj.audit.drift import learned_drift, true_drift
from dnnmso_mj.audit.region import Region
from dnnmso_mj.controllers import Controller
from dnnmso_mj.plant import Plant

Array = np.ndarray

GRID = 31  # states a side
REACH = 1.6  # half ranges that a map shows


@dataclass(frozen=True)
class Slice:
    """Two coordinates of the state vary, the others stay.

    Args:
        axes: which two of x = [q; q̇].
        x, y: their values, each (GRID,).
        f_true, f_hat: true and learned accelerations (GRID, GRID, n) rad/s², y by row.
    """

    axes: tuple[int, int]
    x: Array
    y: Array
    f_true: Array
    f_hat: Array


@dataclass(frozen=True)
class Portrait:
    """One frozen model.

    Args:
        controller: its name.
        at: when it was frozen (s).
        seed: of the run.
        slices: the maps.
        t: times of the last learning (N,) s.
        visited: true states of then (N, 2n).
        f_true, f_hat: at these (N, n) rad/s².
    """

    controller: str
    at: float
    seed: int
    slices: tuple[Slice, ...]
    t: Array
    visited: Array
    f_true: Array
    f_hat: Array


def map_slices(plant: Plant, controller: Controller, region: Region) -> tuple[Slice, ...]:
    """First two angles at rest, and first two velocities at the middle of the visited angles.

    One joint has but one map: angle and velocity.
    """
    n = region.n_joints
    pairs = [(0, 1), (n, n + 1)] if n > 1 else [(0, 1)]
    return tuple(_slice(plant, controller, region, axes) for axes in pairs)


def _slice(plant: Plant, controller: Controller, region: Region, axes: tuple[int, int]) -> Slice:
    i, j = axes
    reach = np.linspace(-REACH, REACH, GRID)
    x, y = (region.centre[k] + reach * region.half[k] for k in axes)
    states = np.tile(region.middle, (GRID * GRID, 1))
    states[:, i], states[:, j] = np.tile(x, GRID), np.repeat(y, GRID)
    shape = (GRID, GRID, region.n_joints)
    f_true, f_hat = true_drift(plant, states), learned_drift(controller, states)
    return Slice(axes, x, y, f_true.reshape(shape), f_hat.reshape(shape))
