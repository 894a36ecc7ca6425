"""The paper's statements, as numbers that can be watched while a controller runs.

Learning (section 4): deep relative trust bounds how far one update turns the gradient,

    ‖g_k(W+ΔW) − g_k(W)‖/‖g_k(W)‖ ≤ Π_l (1 + ‖ΔW_l‖/‖W_l‖) − 1,

and Theorem 1 guarantees descent while η < (1 + cos γ_k)^{1/L} − 1 for every layer k, where γ_k is
the angle between |g_k| and |W_k|. N.B. the paper's closing parenthesis is misplaced.

Tracking (section 5): with s = ė + λe and both K and Λ = λI scalar, ṡ = −K s + d. At a sampling
instant d = f̃₂ + λf̃₁; between two, torque and f̂ are held while arm and reference move on, and d
with them. If ‖d‖ ≤ ε after some time, then ultimately ‖s‖ ≤ ε/K and |e_i| ≤ ε/(Kλ).
`TrackingBounds` integrates these comparison equations with the true ‖d(t)‖: that holds during the
transient too, and settles at the ultimate bound when ‖d‖ does. The paper's own bound,
‖e_r‖ ≤ ε/λ_min(K) with ‖f̃‖ ≤ ε, is integrated likewise; it presumes an inversion of all 2n rows,
which slack variables do not give. Both are bounds of the continuous arm. RK4 keeps to it; Euler and
implicitfast slip from it each period by ½dt²·q̈ in q and ½dt·Δq̈ in q̇, which the joint bound adds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import compiled, copy, inner
from dnnmso_mj.inversion import slack_coupling, slack_matrix
from dnnmso_mj.scenario import Inversion as InversionSpec
from dnnmso_mj.scenario import expand

Array = np.ndarray

# Columns of the sums over a layer of one update.
W_SQ, G_SQ, GW, DW_SQ, CLIPPED = range(5)

UNDEFINED = -1.0  # logged where a bound does not exist for the gains in use


@compiled
def layer_monitors(
    stats: Array, weight_norm: Array, update_ratio: Array, eta_bound: Array
) -> tuple[float, float]:
    """Per-layer monitors of one update, from the sums of `monitors`.

    Args:
        stats: (L, 5) sums of Σw², Σg², Σ|g||w|, ΣΔw² and clamped updates.
        weight_norm, update_ratio, eta_bound: (L,) out; ‖W_l‖, ‖ΔW_l‖/‖W_l‖ and Theorem 1's bound.
            A layer without a gradient has bound 0: nothing guarantees descent where nothing moves.

    Returns:
        Π(1 + ‖ΔW_l‖/‖W_l‖) − 1 and the number of clamped updates.
    """
    n_layers = stats.shape[0]
    product, clipped = 1.0, 0.0
    for k in range(n_layers):
        norm = math.sqrt(stats[k, W_SQ])
        weight_norm[k] = norm
        update_ratio[k] = math.sqrt(stats[k, DW_SQ]) / norm
        gradient_norm = math.sqrt(stats[k, G_SQ])
        if gradient_norm > 0.0:
            cosine = min(stats[k, GW] / (gradient_norm * norm), 1.0)
            eta_bound[k] = (1.0 + cosine) ** (1.0 / n_layers) - 1.0
        else:
            eta_bound[k] = 0.0
        product *= 1.0 + update_ratio[k]
        clipped += stats[k, CLIPPED]
    return product - 1.0, clipped


class TrackingBounds(NamedTuple):
    """Live bounds on the tracking error, driven by the true f̃.

    For each control period: `begin_period` with what acts when the torque is set, `end_period` with
    what has become of it just before the next torque.
    """

    joint: Array  # (1,) bound on every |q_i − q_ref,i| (rad), or −1 where K or Λ is not scalar
    paper: Array  # (1,) the paper's bound on ‖e_r‖, or −1 without an inversion
    s: Array  # (1,) bound on ‖ė + λe‖
    norms: Array  # (2,) ‖d‖ and ‖f̃‖ at the period's begin
    qdd: Array  # (n,) rad/s² at the period's begin
    gains: Array  # (2,) K and λ
    holds: Array  # (3, 2) decay and gain of s, e and the paper's bound over a period
    dt: float
    first_order: bool  # whether the integrator errs by more than terms of dt³


def build_bounds(
    spec: InversionSpec | None, n_joints: int, dt: float, *, first_order: bool
) -> TrackingBounds:
    """Bounds for the inversion's K and slack matrix, none for another law; then `start_bounds`."""
    n = n_joints
    if spec is None:
        return build_bounds(InversionSpec(), n, dt, first_order=first_order)._replace(
            joint=np.full(1, UNDEFINED), paper=np.full(1, UNDEFINED)
        )
    K, coupling = expand(spec.K, 2 * n), slack_coupling(slack_matrix(spec, n))
    gain, lam = float(K[0]), float(coupling[0, 0])
    scalar = bool(np.ptp(K) == 0 and np.array_equal(coupling, lam * np.eye(n)))
    return TrackingBounds(
        joint=np.full(1, 0.0 if scalar else UNDEFINED),
        paper=np.zeros(1),
        s=np.zeros(1),
        norms=np.zeros(2),
        qdd=np.zeros(n),
        gains=np.array([gain, lam]),
        holds=np.array([_hold(gain, dt), _hold(lam, dt), _hold(float(K.min()), dt)]),
        dt=dt,
        first_order=first_order,
    )


def start_bounds(bounds: TrackingBounds, e_track: Array) -> None:
    """Start at the tracking error e_r (2n,)."""
    n, lam = e_track.size // 2, bounds.gains[1]
    if bounds.joint[0] != UNDEFINED:
        bounds.joint[0] = np.linalg.norm(e_track[:n])
    bounds.s[0] = np.linalg.norm(e_track[n:] + lam * e_track[:n])
    if bounds.paper[0] != UNDEFINED:
        bounds.paper[0] = np.linalg.norm(e_track)


@inner
def begin_period(
    bounds: TrackingBounds, f_err: Array, e_track: Array, qdd: Array, qdd_ref: Array
) -> None:
    """A period begins with f̃ (2n,) at e_r (2n,), with q̈ (n,) under the torque that is applied."""
    f_sq = 0.0
    for i in range(f_err.size):
        f_sq += f_err[i] ** 2
    bounds.norms[0] = _disturbance(bounds, e_track, qdd, qdd_ref)
    bounds.norms[1] = math.sqrt(f_sq)
    copy(qdd, bounds.qdd)


@inner
def _disturbance(bounds: TrackingBounds, e_track: Array, qdd: Array, qdd_ref: Array) -> float:
    """‖d‖ with d = ṡ + K s = ë + (K + λ) ė + Kλ e.

    That is f̃₂ + λ f̃₁ where the law commands, and holds too where a torque limit or the watchdog
    acts instead.
    """
    n, d_sq = qdd.size, 0.0
    K, lam = bounds.gains
    for i in range(n):
        edd = qdd[i] - qdd_ref[i]
        d_sq += (edd + (K + lam) * e_track[n + i] + K * lam * e_track[i]) ** 2
    return math.sqrt(d_sq)


@inner
def end_period(bounds: TrackingBounds, e_track: Array, qdd: Array, qdd_ref: Array) -> None:
    """The period ends at e_r (2n,), with q̈ (n,) rad/s² under the torque that was held.

    ‖d‖ in between is at most the mean of both ends, but for terms of order dt².
    """
    if bounds.paper[0] != UNDEFINED:
        decay, gain = bounds.holds[2]
        bounds.paper[0] = decay * bounds.paper[0] + gain * bounds.norms[1]
    if bounds.joint[0] == UNDEFINED:
        return
    n, dt = qdd.size, bounds.dt
    q_slip_sq = v_slip_sq = 0.0
    for i in range(n):
        q_slip_sq += (0.5 * dt * dt * bounds.qdd[i]) ** 2
        v_slip_sq += (0.5 * dt * (qdd[i] - bounds.qdd[i])) ** 2
    s_before = bounds.s[0]
    s = bounds.holds[0, 0] * s_before
    d_norm = _disturbance(bounds, e_track, qdd, qdd_ref)
    s += bounds.holds[0, 1] * 0.5 * (bounds.norms[0] + d_norm)
    joint = bounds.holds[1, 0] * bounds.joint[0]
    if bounds.first_order:
        s += math.sqrt(v_slip_sq) + bounds.gains[1] * math.sqrt(q_slip_sq)
        joint += math.sqrt(q_slip_sq)
    bounds.s[0] = s
    bounds.joint[0] = joint + bounds.holds[1, 1] * max(s, s_before)


def _hold(pole: float, dt: float) -> tuple[float, float]:
    """Exact sampled solution of ẏ = −pole·y + v with v held: y ← decay·y + gain·v."""
    return math.exp(-pole * dt), dt if pole == 0.0 else -math.expm1(-pole * dt) / pole
