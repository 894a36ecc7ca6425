"""Rivals without learning: feedback, inverse dynamics, disturbance observers, robust laws.

Unless said otherwise a default puts all poles of the tracking error at -7.5 1/s, where the paper's
K = λ = 7.5 puts them, so that rivals differ by how they meet what they do not know. Laws that
command torque without a model take J = 10.2 kg·m² for the inertia: the largest that joint 1 of the
paper's arm sees. Nothing is fitted to a run.
"""

from __future__ import annotations

from typing import Literal

from dnnmso_mj.scenario.effectiveness import Effectiveness, Inertia
from dnnmso_mj.scenario.fields import PositiveEach, Strict


class Pd(Strict):
    """Proportional-derivative feedback at each joint; no model."""

    kind: Literal["pd"]
    """PD."""
    kp: PositiveEach = (574.0,)
    """Position gain (N·m/rad), each; J ω² for a double pole at -ω = -7.5 1/s."""
    kd: PositiveEach = (153.0,)
    """Velocity gain (N·m·s/rad), each; 2 J ω."""


class Pid(Strict):
    """PD and an integral that stops winding up where the drive gives less than was asked."""

    kind: Literal["pid"]
    """PID."""
    kp: PositiveEach = (765.0,)
    """Position gain (N·m/rad), each; 3 J ω² for a triple pole at -ω = -5 1/s."""
    ki: PositiveEach = (1275.0,)
    """Integral gain (N·m/(rad·s)), each; J ω³."""
    kd: PositiveEach = (153.0,)
    """Velocity gain (N·m·s/rad), each; 3 J ω, as much as that of pd."""


class ComputedTorque(Strict):
    """Inverse dynamics of the nominal model, and PD of the acceleration."""

    kind: Literal["computed_torque"]
    """Computed torque."""
    kp: PositiveEach = (56.25,)
    """Position gain (1/s²), each; ω² for a double pole at -ω = -7.5 1/s."""
    kd: PositiveEach = (15.0,)
    """Velocity gain (1/s), each; 2 ω."""
    effectiveness: Inertia = Inertia(kind="inertia")
    """The model: its masses and lengths give M, V and G."""


class Adrc(Strict):
    """Active disturbance rejection: linear extended state observer and bandwidths."""

    kind: Literal["adrc"]
    """ADRC."""
    controller_bandwidth: PositiveEach = (7.5,)
    """ω_c (1/s), each: the double pole of the tracking error is at -ω_c."""
    observer_bandwidth: PositiveEach = (75.0,)
    """ω_o (1/s), each: the triple pole of the observer is at -ω_o; ten times ω_c."""
    effectiveness: Effectiveness = Inertia(kind="inertia")
    """b₀, what a torque does: a nominal inertia, or one number."""


class SlidingMode(Strict):
    """Sliding mode control, the switching smoothed in a boundary layer."""

    kind: Literal["sliding_mode"]
    """Sliding mode with a boundary layer."""
    lam: PositiveEach = (7.5,)
    """λ (1/s), each: pole of the error while s = ė + λ e stays at zero."""
    gain: PositiveEach = (40.0,)
    """k (rad/s²), each; above the drift acceleration, up to 19 rad/s² on the paper's motion."""
    boundary_layer: PositiveEach = (0.4,)
    """φ (rad/s), each: half the layer's width; k/φ = 100 1/s is the bandwidth within."""
    effectiveness: Effectiveness = Inertia(kind="inertia")
    """What a torque does: a nominal inertia, or one number."""


class Rise(Strict):
    """Robust integral of the sign of the error: continuous torque, no model."""

    kind: Literal["rise"]
    """RISE."""
    ks: PositiveEach = (152.0,)
    """k_s (N·m·s/rad), each; k_s + 1 is the velocity gain, as much as that of pd."""
    alpha1: PositiveEach = (2.5,)
    """α₁ (1/s), each; the theory wants more than 1/2."""
    alpha2: PositiveEach = (2.5,)
    """α₂ (1/s), each; the theory wants more than 1."""
    beta: PositiveEach = (30.0,)
    """β (N·m/s), each; above |Ṅ| + |N̈|/α₂ = 25 of the torque N that the paper's motion takes."""


class L1(Strict):
    """L1 adaptive control with the piecewise-constant adaptation law."""

    kind: Literal["l1"]
    """L1 adaptive control."""
    kp: PositiveEach = (56.25,)
    """Position gain (1/s²), each; ω² for a double pole at -ω = -7.5 1/s."""
    kd: PositiveEach = (15.0,)
    """Velocity gain (1/s), each; 2 ω."""
    predictor_gain: PositiveEach = (1.0,)
    """a (1/s), each: decay of the predictor's error; the share a dt of σ is not compensated."""
    filter_bandwidth: PositiveEach = (75.0,)
    """ω_f (1/s), each: what is slower is compensated, the rest is left to feedback."""
    effectiveness: Effectiveness = Inertia(kind="inertia")
    """What a torque does: a nominal inertia, or one number."""


Rival = Pd | Pid | ComputedTorque | Adrc | SlidingMode | Rise | L1
