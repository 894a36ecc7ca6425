"""What the sensors say of the arm's state x = [q; q̇].

    reading(t) = x(t − age) + bias + drift(t) + noise(t),    age = sensor_delay + jitter·U(0, 1)

The past is interpolated linearly between ticks; before the start it is the initial state. Angles
are then rounded to the encoder's steps 2π/counts. Where there is no velocity sensor, q̇ is the
difference of the angles read over one period, low-passed: v ← a v + (1 − a) Δq/dt, a = exp(−dt/T),
from rest.

Every source has a random stream of its own, made of the scenario's seed and the source's number
alone: neither the controller nor another imperfection changes what it gives. The streams are drawn
a chunk of ticks ahead, so that a tick draws nothing.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import compiled, copy, inner
from dnnmso_mj.scenario import Imperfections, expand

Array = np.ndarray

# Numbers of the random streams; a change of one changes every seeded run.
POSITION_NOISE, VELOCITY_NOISE, POSITION_DRIFT, VELOCITY_DRIFT, JITTER = range(5)
N_STREAMS = 5


class Sensors(NamedTuple):
    """The sensors as compiled code sees them."""

    past: Array  # (m, 2n) true states, a ring
    error: Array  # (chunk, 2n + 1) bias, drift and noise of each tick; its reading's age in periods
    last: Array  # (2n,) the last reading
    settings: Array  # (n + 2,) rad, the encoder's steps or 0; a and (1 − a)/dt of the difference
    differenced: bool
    perfect: bool


class SensorBank:
    """The sensors of a scenario, and the random numbers in them.

    Args:
        spec: the scenario's imperfections.
        n_joints: n.
        dt: control period (s).
        seed: of the scenario.
        chunk: ticks to draw at once; it changes nothing of what is drawn.

    Attributes:
        view: the sensors for compiled code.
    """

    def __init__(
        self, spec: Imperfections, n_joints: int, dt: float, seed: int, chunk: int
    ) -> None:
        n = n_joints
        self._seed = seed
        self._white = _each(spec.position_noise, spec.velocity_noise, n)
        self._walk = _each(spec.position_drift, spec.velocity_drift, n) * math.sqrt(dt)
        self._bias = _each(spec.position_bias, spec.velocity_bias, n)
        self._delay, self._jitter = spec.sensor_delay / dt, spec.jitter / dt
        counts, smooth = spec.encoder_counts, spec.velocity_filter
        steps = np.zeros(n) if counts is None else 2.0 * np.pi / expand(counts, n)
        decay = math.exp(-dt / smooth) if smooth > 0.0 else 0.0
        differenced = spec.velocity_from == "difference"
        erring = np.concatenate([self._white, self._walk, self._bias]).any()
        late = self._delay + self._jitter
        self.view = Sensors(
            past=np.zeros((math.ceil(late) + 2, 2 * n)),
            error=np.zeros((chunk, 2 * n + 1)),
            last=np.zeros(2 * n),
            settings=np.array([*steps, decay, (1.0 - decay) / dt]),
            differenced=differenced,
            perfect=not (erring or late or counts or differenced),
        )

    def start(self, x: Array) -> None:
        """Begin the streams anew, with an arm that has always been at x (2n,); then `draw`."""
        seeds = (np.random.SeedSequence(self._seed, spawn_key=(k,)) for k in range(N_STREAMS))
        self._streams = [np.random.default_rng(seed) for seed in seeds]
        self._drift = np.zeros((1, x.size))
        self.view.past[:] = x
        self.view.last[:] = 0.0

    def draw(self) -> None:
        """The random numbers of the next chunk of ticks."""
        view = self.view
        if view.perfect:
            return
        chunk, n = len(view.error), view.last.size // 2

        def normal(positions: int, velocities: int) -> Array:
            drawn = [self._streams[k].standard_normal((chunk, n)) for k in (positions, velocities)]
            return np.hstack(drawn)

        walk = self._walk * normal(POSITION_DRIFT, VELOCITY_DRIFT)
        drift = np.cumsum(np.vstack([self._drift, walk]), axis=0)
        self._drift = drift[-1:]
        white = self._white * normal(POSITION_NOISE, VELOCITY_NOISE)
        view.error[:, :-1] = self._bias + drift[:-1] + white
        view.error[:, -1] = self._delay + self._jitter * self._streams[JITTER].random(chunk)


def _each(positions: tuple[float, ...], velocities: tuple[float, ...], n: int) -> Array:
    return np.concatenate([expand(positions, n), expand(velocities, n)])


@inner
def sense(sensors: Sensors, x: Array, k: int, i: int, out: Array) -> None:
    """What the sensors say at tick k, the i-th of its chunk, of an arm at x (2n,), into `out`."""
    if sensors.perfect:
        copy(x, out)
    else:
        _recall(sensors.past, x, k, sensors.error[i], out)
        _resolve(sensors.settings, sensors.differenced, k, sensors.last, out)


@compiled
def _recall(past: Array, x: Array, k: int, error: Array, out: Array) -> None:
    """The state of some time ago, with its error."""
    size, age = len(past), error[x.size]
    whole = int(age)
    for j in range(x.size):
        past[k % size, j] = x[j]
        newer = past[(k - whole) % size, j]
        older = past[(k - whole - 1) % size, j]
        out[j] = newer + (age - whole) * (older - newer) + error[j]


@compiled
def _resolve(settings: Array, differenced: bool, k: int, last: Array, out: Array) -> None:
    """The encoder's steps, and the velocity made of them."""
    n = last.size // 2
    for j in range(n):
        step = settings[j]
        if step > 0.0:
            out[j] = math.floor(out[j] / step + 0.5) * step
        if differenced:
            change = out[j] - last[j] if k > 0 else 0.0
            out[n + j] = settings[n] * last[n + j] + settings[n + 1] * change
    copy(out, last)
