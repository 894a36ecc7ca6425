"""The state that a torque commanded now will meet, when it comes late by a known delay.

At tick k the sensors show the state of tick k − d_s, and the command acts from tick k + d_a on.
What acts in the D = d_s + d_a periods between is known: the drives report it, or it is on its way.
So the model is integrated over them,

    q̈ = f̂(x) + d̂ + B₂(q) τ,    d̂ held,

in steps of at most `LONGEST` (a Smith predictor in state space: Smith 1957, Manitius and Olbrot
1979).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import compiled, copy, inner
from dnnmso_mj.inversion import DynamicInversion, solve_spd
from dnnmso_mj.kernel import Net, forward, prediction
from dnnmso_mj.plant import inertia
from dnnmso_mj.scenario import KnownDelay

Array = np.ndarray

LONGEST = 0.002  # s


class Predictor(NamedTuple):
    """The torques of the periods between measurement and action."""

    tau: Array  # (D + 1, n) N·m: of periods k − d_s … k + d_a, where k is the tick at hand
    sensor: int  # d_s, ticks
    stride: int  # periods that are integrated at once
    dt: float  # s
    x: Array  # (2n,) the predicted state
    mean: Array  # (n,) scratch
    free: Array  # (n,) scratch
    L: Array  # (n, n) scratch


def build_predictor(spec: KnownDelay, n_joints: int, dt: float) -> Predictor:
    """A predictor over known delays, which are rounded to whole ticks."""
    n, sensor, actuator = n_joints, round(spec.sensor / dt), round(spec.actuator / dt)
    return Predictor(
        tau=np.zeros((sensor + actuator + 1, n)),
        sensor=sensor,
        stride=max(1, math.floor(LONGEST / dt + 1e-9)),
        dt=dt,
        x=np.zeros(2 * n),
        mean=np.zeros(n),
        free=np.zeros(n),
        L=np.zeros((n, n)),
    )


@compiled
def report(tau: Array, sensor: int, acted: Array, past: Array) -> None:
    """Tick k begins: what acted in the period before it is known, and one period is behind it.

    Args:
        tau: of a `Predictor`.
        sensor: d_s, ticks.
        acted: (n,) N·m, in the period before tick k.
        past: (n,) out: N·m, in the period before the measured state.
    """
    copy(acted, tau[sensor])
    copy(tau[0], past)
    for i in range(len(tau) - 1):
        copy(tau[i + 1], tau[i])


@inner
def predict(
    predictor: Predictor, inversion: DynamicInversion, net: Net, x: Array, d_hat: Array
) -> None:
    """The state ahead of the measured x (2n,), into `predictor.x`; d_hat (n,) rad/s² is held."""
    n, ahead = d_hat.size, predictor.x
    copy(x, ahead)
    periods = len(predictor.tau) - 1
    for first in range(0, periods, predictor.stride):
        count = min(predictor.stride, periods - first)
        for j in range(n):
            predictor.mean[j] = 0.0
            for i in range(first, first + count):
                predictor.mean[j] += predictor.tau[i, j] / count
        forward(net, ahead)
        output = prediction(net)
        if inversion.constant:
            for j in range(n):
                predictor.free[j] = predictor.mean[j] / inversion.B2_inv[j, j]
        else:
            inertia(inversion.nominal, ahead[:n])
            solve_spd(inversion.nominal.M, predictor.mean, predictor.free, predictor.L)
        step = count * predictor.dt
        for j in range(n):
            qdd = output[j] + d_hat[j] + predictor.free[j]
            ahead[j] += step * (ahead[n + j] + 0.5 * step * qdd)
            ahead[n + j] += step * qdd
