"""Command filters: a command made smooth, with its rate, for the next step of a backstepping law.

    ċ = ν + p + 2ω (α − c),   ṗ = ω² (α − c)

follows α with two poles at −ω and without error where α̇ − ν is constant; ν is what is known of α̇.
At the control period both poles are at exp(−ω dt), for any ω.

Source: Farrell, Polycarpou, Sharma, Dong, "Command filtered backstepping", IEEE Transactions on
Automatic Control 54(6), 2009. N.B. theirs, ω²/(s² + 2ζω s + ω²), lags behind a ramp; this does not.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import inner

Array = np.ndarray


class CommandFilter(NamedTuple):
    """A filter for commands of n entries."""

    value: Array  # c (n,)
    rate: Array  # ċ (n,): change of `value` in the last period, by dt
    slope: Array  # p (n,)
    gains: Array  # (2,) of `rate` and, times dt, of `slope` (1/s, 1/s)
    ahead: float  # s: how much later α is than `value`
    dt: float  # s


def build_filter(bandwidth: float, n: int, dt: float, *, ahead: bool) -> CommandFilter:
    """A filter of bandwidth ω (rad/s) and control period dt (s).

    Args:
        ahead: whether each α is for the moment at which that tick's `follow` leaves the filter, one
            period after the moment of `value` before it; else both are for the same moment.
    """
    decay = math.exp(-bandwidth * dt)
    gain = (1.0 - decay * decay if ahead else 2.0 * (1.0 - decay)) / dt
    value, rate, slope = np.zeros((3, n))
    gains = np.array([gain, (1.0 - decay) ** 2 / dt])
    return CommandFilter(value, rate, slope, gains, dt if ahead else 0.0, dt)


@inner
def start_filter(command: CommandFilter, i: int, alpha: float) -> None:
    """Entry i stands at α, and still."""
    command.value[i] = alpha
    command.rate[i] = 0.0
    command.slope[i] = 0.0


@inner
def follow(command: CommandFilter, i: int, alpha: float, known: float) -> None:
    """One period of entry i towards α, of whose rate ν = `known`."""
    behind = alpha - command.value[i] - command.ahead * (known + command.slope[i])
    command.rate[i] = known + command.slope[i] + command.gains[0] * behind
    command.slope[i] += command.gains[1] * behind
    command.value[i] += command.dt * command.rate[i]
