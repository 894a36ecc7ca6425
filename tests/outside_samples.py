"""Code from outside the package, as a file, a module and an installed package, for the tests."""

from __future__ import annotations

from pathlib import Path

LAWS = '''
import numpy as np
from collections import deque, namedtuple
from dataclasses import dataclass


class Pd:
    def __init__(self, setup, kp=512.0, kd=128.0):
        self.kp, self.kd = kp, kd

    def update(self, inputs):
        return -self.kp * (inputs.q - inputs.q_ref) - self.kd * (inputs.qd - inputs.qd_ref)


class Remembers(Pd):
    """An integral, a list, a text, none, and a random number at each tick."""

    def __init__(self, setup):
        super().__init__(setup)
        self.rng, self.dt = setup.rng, setup.dt
        self.integral, self.drawn = np.zeros(setup.n_joints), np.float64(0.0)
        self.past, self.first, self.pair = [], None, (0, "none")

    def reset(self, x):
        self.begun_at = x

    def update(self, inputs):
        self.integral += (inputs.q - inputs.q_ref) * self.dt
        self.drawn = self.rng.standard_normal()
        self.past = [*self.past, float(inputs.q[0])][-3:]
        self.first = self.past[0] if self.first is None else self.first
        self.pair = (self.pair[0] + 1, "some")
        return super().update(inputs) - 200.0 * self.integral + self.drawn + sum(self.past)


class Slotted:
    """Tuples in lists and dicts, in attributes that are in no dict."""

    __slots__ = ("past", "sums", "rng")

    def __init__(self, setup):
        self.past, self.sums, self.rng = [(0.0, 0.0)], {"e": (0.0,)}, setup.rng

    def update(self, inputs):
        e, ed = inputs.q - inputs.q_ref, inputs.qd - inputs.qd_ref
        q1, q2, one = self.past[-1] + (1.0,)
        self.past = [*self.past, (float(e[0]), float(e[1]))][-3:]
        self.sums = {"e": (*self.sums["e"][-2:], q1 + q2)}
        return -512.0 * e - 128.0 * ed - one * sum(self.sums["e"] + (self.rng.random(),))


@dataclass(frozen=True)
class Frozen:
    setup: object
    kp: float = 512.0

    def update(self, inputs):
        return -self.kp * (inputs.q - inputs.q_ref) - 128.0 * (inputs.qd - inputs.qd_ref)


class Named(Pd):
    """What JSON would give back as a mere tuple."""

    def __init__(self, setup):
        super().__init__(setup)
        self.gains = namedtuple("Gains", "kp")(3.0)


class Same:
    """A whole Controller: the package's own PD."""

    def __new__(cls, setup, **settings):
        from dnnmso_mj.controllers.pd import PdController
        from dnnmso_mj.scenario import Pd as Spec

        return PdController(Spec(kind="pd", **settings), setup.n_joints)


class Silent:
    def __init__(self, setup):
        pass


class Half(Silent):
    n_layers = 0

    def update(self, inputs):
        return np.zeros(2)


class Wide(Silent):
    def update(self, inputs):
        return np.zeros(3)


class Breaks(Silent):
    def update(self, inputs):
        return 1 / 0


class Blind(Silent):
    def update(self, inputs):
        return inputs.q * np.nan


class Queues(Silent):
    def __init__(self, setup):
        self.past = deque()

    update = Blind.update


class Forgets(Blind):
    def state(self):
        return {}


class Untold(Blind):
    n_layers = 0

    def reset(self, x):
        pass

    def dynamics(self, x):
        return x

    def state(self):
        return {}

    def restore(self, state):
        pass


NUMBER = 3


def swing(t, size=1.0, slip=0.0):
    angle = 0.5 * t[:, None] + [0.0, np.pi / 2]
    sine = size * np.sin(angle)
    return sine, size * 0.5 * np.cos(angle) + slip, -0.25 * sine


def two(t):
    return swing(t)[:2]


def flat(t):
    return tuple(part[:, 0] for part in swing(t))


def ends(t):
    return tuple(part / (t < 0.4)[:, None] for part in swing(t))


def ramp(t, at):
    moving = (t > at) & (t < at + 0.1)
    q = np.clip(t - at, 0.0, 0.1)[:, None] * [1.0, 1.0]
    return q, moving[:, None] * [1.0, 1.0], 0.0 * q


class Off:
    """Readings with an offset, torques with a gain."""

    def __init__(self, setup, offset=0.01, gain=0.5):
        self.offset, self.gain = offset, gain

    def sense(self, t, x):
        return x + self.offset

    def actuate(self, t, tau):
        return self.gain * tau


class Noisy:
    def __init__(self, setup, size=0.01):
        self.rng, self.size, self.last = setup.rng, size, 0.0

    def sense(self, t, x):
        self.last = 0.9 * self.last + self.size * self.rng.standard_normal(x.size)
        return x + self.last


class BadSensor:
    def __init__(self, setup, at):
        self.at = at

    def sense(self, t, x):
        return x if t < self.at else x / 0.0


class BadDrive(BadSensor):
    sense = None

    def actuate(self, t, tau):
        return tau if t < self.at else tau * np.nan
'''

CANARY = """
from pathlib import Path

Path(__file__).with_name("it_ran").touch()
Name = None
"""

ENTRY_POINTS = """
[dnnmso_mj.controllers]
outside_pd = outside_package.laws:Pd
broken = outside_package.laws:Gone

[dnnmso_mj.references]
outside_swing = outside_package.laws:swing

[dnnmso_mj.imperfections]
outside_off = outside_package.laws:Off

[dnnmso_mj.models]
outside_arm = outside_package.arms:arm.xml
"""


def write_package(site: Path, arm: str) -> None:
    """An installed package, as pip would leave it: its modules, a model and its entry points."""
    package, about = site / "outside_package", site / "outside_package-1.0.dist-info"
    for folder in (package / "arms", about):
        folder.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "laws.py").write_text(LAWS)
    (package / "arms" / "arm.xml").write_text(arm)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: outside_package\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(ENTRY_POINTS)
