"""The additive update rules that Madam is held against, compiled over flat vectors of weights.

    SGD        m ← μ m + g                                            W ← W − η m
    Adam       m ← β₁ m + (1−β₁) g,  v ← β₂ v + (1−β₂) g²             W ← W − η m̂/(√v̂ + ε)
               with m̂ = m/(1 − β₁ᵏ), v̂ = v/(1 − β₂ᵏ)
    sign-SGD   W ← W − η sign(g)                                      sign(0) = 0

A weight without a gradient stays where it is, so padding of zeros is inert.

Sources: Polyak 1964 (momentum); Kingma and Ba 2015, Alg. 1 (Adam); Bernstein et al. 2018 (signSGD).
The torch reference is `dnnmso_mj.torch_optimizers`.
"""

from __future__ import annotations

import math

import numpy as np

from dnnmso_mj.compiling import compiled

Array = np.ndarray

MADAM, SGD, ADAM, SIGN_SGD = range(4)


@compiled
def descend(
    rule: int, settings: Array, updates: int, w: Array, g: Array, m: Array, v: Array
) -> None:
    """One update of w (N,) from its gradient g (N,) by one of the rules above.

    Args:
        rule: SGD, ADAM or SIGN_SGD.
        settings: (4,) η and the rule's others, in the order of its scenario.
        updates: k, this one included.
        m, v: (N,) first and second moments; each is touched by those rules alone that have it.
    """
    real = w.dtype.type
    eta, first, second, eps = settings
    if rule == SGD:
        _sgd(w, g, m, real(eta), real(first))
    elif rule == ADAM:
        rate, root = eta / (1.0 - first**updates), math.sqrt(1.0 - second**updates)
        _average(g, m, v, first, second)
        _adam(w, m, v, real(rate), real(root), real(eps))
    else:
        _sign(w, g, real(eta))


@compiled
def _sgd(w: Array, g: Array, m: Array, eta: float, momentum: float) -> None:
    for i in range(w.size):
        m[i] = momentum * m[i] + g[i]
        w[i] -= eta * m[i]


@compiled
def _average(g: Array, m: Array, v: Array, beta1: float, beta2: float) -> None:
    """Let the moments take in a gradient."""
    real = g.dtype.type
    keep1, new1, keep2, new2 = real(beta1), real(1.0 - beta1), real(beta2), real(1.0 - beta2)
    for i in range(g.size):
        m[i] = keep1 * m[i] + new1 * g[i]
        v[i] = keep2 * v[i] + new2 * g[i] * g[i]


@compiled
def _adam(w: Array, m: Array, v: Array, rate: float, root: float, eps: float) -> None:
    """`rate` is η/(1 − β₁ᵏ), `root` √(1 − β₂ᵏ)."""
    for i in range(w.size):
        w[i] -= rate * m[i] / (math.sqrt(v[i]) / root + eps)


@compiled
def _sign(w: Array, g: Array, eta: float) -> None:
    real = w.dtype.type
    for i in range(w.size):
        w[i] -= eta * (real(g[i] > 0) - real(g[i] < 0))
