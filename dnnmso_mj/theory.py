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
which slack variables do not give. Both are bounds of the continuous arm: RK4 keeps to them, while
MuJoCo's Euler adds up to dt/2·Δė of its own to e, which can exceed a very small bound.
"""

from __future__ import annotations

import math

import numpy as np

from dnnmso_mj.inversion import slack_coupling, slack_matrix
from dnnmso_mj.kernel import CLIPPED, DW_SQ, G_SQ, GW, W_SQ, compiled
from dnnmso_mj.scenario import Inversion as InversionSpec
from dnnmso_mj.scenario import expand

Array = np.ndarray

UNDEFINED = -1.0  # logged where a bound does not exist for the gains in use


@compiled
def layer_monitors(
    stats: Array, weight_norm: Array, update_ratio: Array, eta_bound: Array
) -> tuple[float, float]:
    """Per-layer monitors of one update, from the sums that `kernel.learn` leaves.

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


class TrackingBounds:
    """Live bounds on the tracking error, driven by the true f̃.

    For each control period: `begin` with what acts when the torque is set, `end` with what has
    become of it just before the next torque.

    Args:
        spec: K and the slack matrix of the inversion.
        n_joints: n.
        dt: control period (s).
        e_track: initial e_r = X − X_d (2n,).

    Attributes:
        joint: bound on every |q_i − q_ref,i| (rad), or -1 where K or Λ is not scalar.
        paper: the paper's bound on ‖e_r‖.
    """

    def __init__(self, spec: InversionSpec, n_joints: int, dt: float, e_track: Array) -> None:
        n = n_joints
        K, coupling = expand(spec.K, 2 * n), slack_coupling(slack_matrix(spec, n))
        self._K, self._lam = float(K[0]), float(coupling[0, 0])
        self._scalar = bool(np.ptp(K) == 0 and np.array_equal(coupling, self._lam * np.eye(n)))
        self._n = n
        self._s_decay, self._s_gain = _hold(self._K, dt)
        self._e_decay, self._e_gain = _hold(self._lam, dt)
        self._x_decay, self._x_gain = _hold(float(K.min()), dt)
        self._d_norm = self._f_err_norm = 0.0
        e, ed = e_track[:n], e_track[n:]
        self._s = float(np.linalg.norm(ed + self._lam * e))
        self.joint = float(np.linalg.norm(e)) if self._scalar else UNDEFINED
        self.paper = float(np.linalg.norm(e_track))

    def begin(self, f_err: Array) -> None:
        """A period begins in which f̃ (2n,) acts, torque saturation included."""
        d = self._lam * f_err[: self._n]
        d += f_err[self._n :]
        self._d_norm = math.sqrt(d.dot(d))
        self._f_err_norm = math.sqrt(f_err.dot(f_err))

    def end(self, e_track: Array, edd: Array) -> None:
        """The period ends at e_r (2n,), with ë (n,) rad/s² under the torque that was held.

        There d = ë + (K + λ) ė + Kλ e, by the definition of s alone; ‖d‖ in between is at most the
        mean of both ends, but for terms of order dt².
        """
        self.paper = self._x_decay * self.paper + self._x_gain * self._f_err_norm
        if not self._scalar:
            return
        n, K, lam = self._n, self._K, self._lam
        d = (K + lam) * e_track[n:]
        d += edd
        d += (K * lam) * e_track[:n]
        mean = 0.5 * (self._d_norm + math.sqrt(d.dot(d)))
        s = self._s_decay * self._s + self._s_gain * mean
        self.joint = self._e_decay * self.joint + self._e_gain * max(s, self._s)
        self._s = s


def _hold(pole: float, dt: float) -> tuple[float, float]:
    """Exact sampled solution of ẏ = −pole·y + v with v held: y ← decay·y + gain·v."""
    return math.exp(-pole * dt), dt if pole == 0.0 else -math.expm1(-pole * dt) / pole
