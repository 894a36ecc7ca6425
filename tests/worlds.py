"""Worlds without MuJoCo that a controller drives through `update`: lag, and other first rows."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from dnnmso_mj.controllers import Controller, Inputs, build_controller
from dnnmso_mj.dynamics import TwoLink
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import Scenario

Array = np.ndarray
ARM = TwoLink((1.0, 2.3), (1.0, 1.0))
DT = 1e-3


class World(NamedTuple):
    """ẋ = flow(x, τ), from x₀, with what the sensors make of x."""

    x0: Array
    flow: Callable[[Array, Array], Array]
    sense: Callable[[Array], Array] = np.copy


class Run(NamedTuple):
    """What came of it, a row a tick."""

    e: Array  # q − q_ref of the true state
    tau: Array  # mean that acted in the tick's period
    cmd: Array
    x: Array  # true, at the tick

    def rmse(self) -> float:
        """Of the last quarter; infinite where the run ended early."""
        return float(np.sqrt(np.mean(self.e[3 * len(self.e) // 4 :] ** 2)))

    def chatter(self) -> float:
        """Mean change of the torque that acts from one tick to the next, in the last half."""
        return float(np.abs(np.diff(self.tau[len(self.tau) // 2 :], axis=0)).mean())


def arm_flow(x: Array, tau: Array) -> Array:
    """The paper's arm."""
    return np.concatenate([x[2:], ARM.acceleration(x[:2], x[2:], tau)])


def arm(velocity_bias: float = 0.0) -> World:
    """The paper's arm and start; its velocity sensor may read too much by a constant (rad/s)."""
    offset = np.array([0.0, 0.0, velocity_bias, velocity_bias])
    return World(np.array([0.5, 0.5, 0.0, 0.0]), arm_flow, lambda x: x + offset)


def reference(t: float) -> Array:
    """q_ref, q̇_ref, q̈_ref (6,) of the paper's trajectory."""
    s, c = math.sin(0.5 * t), math.cos(0.5 * t)
    return np.array([s, c, 0.5 * c, -0.5 * s, -0.25 * s, -0.25 * c])


def controller_of(scenario: Scenario, mjcf: Mjcf) -> Controller:
    return build_controller(scenario, mjcf, watch=False)


class Drives:
    """T ẏ = τ_cmd − y, solved exactly; what acts in a period is the mean of y."""

    def __init__(self, lag: float) -> None:
        self.lag, self.y = lag, np.zeros(2)

    def act(self, cmd: Array) -> Array:
        if self.lag == 0.0:
            return np.array(cmd)
        decay = math.exp(-DT / self.lag)
        mean = cmd + (self.y - cmd) * self.lag / DT * (1.0 - decay)
        self.y = cmd + (self.y - cmd) * decay
        return np.array(mean)


def drive(
    controller: Controller,
    world: World,
    seconds: float,
    lag: float = 0.0,
    watch: Callable[[int, Inputs, Array], None] = lambda k, inputs, tau: None,
) -> Run:
    """Run a world with drives of a lag (s); `watch` is told each tick and what acts."""
    inputs, drives, x = Inputs.zeros(2), Drives(lag), world.x0.copy()
    controller.reset(world.sense(x))
    rows: list[tuple[Array, ...]] = []
    for k in range(round(seconds / DT)):
        ref = reference(k * DT)
        inputs.x[:], inputs.x_ref[:], inputs.xd_ref[:] = world.sense(x), ref[:4], ref[2:]
        cmd = controller.update(inputs).tau
        tau = drives.act(cmd)
        watch(k, inputs, tau)
        rows.append((x[:2] - ref[:2], tau, cmd.copy(), x))
        x = _rk4(world.flow, x, tau)
        inputs.tau[:] = tau
        if not np.abs(x).max() < 1e3:
            rows.append((np.full(2, math.inf), *rows[-1][1:]))
            break
    return Run(*(np.array(column) for column in zip(*rows, strict=True)))


def _rk4(flow: Callable[[Array, Array], Array], x: Array, tau: Array) -> Array:
    a = flow(x, tau)
    b = flow(x + 0.5 * DT * a, tau)
    c = flow(x + 0.5 * DT * b, tau)
    d = flow(x + DT * c, tau)
    return x + DT / 6 * (a + 2 * b + 2 * c + d)
