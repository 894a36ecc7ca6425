"""What concurrent learning remembers: pairs (𝒴, 𝒰) with 𝒰 = 𝒴 φ, kept for what they tell of φ.

    S = Σ 𝒴ᵀ𝒴,   b = Σ 𝒴ᵀ𝒰,   φ̂' = k (b − S φ̂)   ⇒   φ̃ decays at the rate k λ_min(S) or faster

While S is singular the newest pair takes the place of the oldest. From then on a pair is taken only
where it raises λ_min(S), in the place where it raises it most, so that what a short excitation told
is never lost again; unless pairs are given an age at which they make way whatever comes.

φ̂ is advanced by the implicit Euler step (I + dt k S) φ̂⁺ = φ̂ + dt k b, stable for every k and S.

Source: Chowdhary, Johnson, "A singular value maximizing data recording algorithm for concurrent
learning", American Control Conference 2011. N.B. theirs stops at a full stack of rank less than
full, since no single pair raises λ_min above zero there; hence the rule of the oldest.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import compiled

Array = np.ndarray

# λ_min below this part of the trace is rounding: S is singular.
SINGULAR_BELOW = 1e-12
BISECTIONS = 40

EMPTY = 2**62  # the age of a place without a pair: older than any


class HistoryStack(NamedTuple):
    """N pairs of m equations for p parameters, and what is made of them."""

    Y: Array  # (N, m, p)
    U: Array  # (N, m)
    S: Array  # (p, p)
    b: Array  # (p,)
    step: Array  # (p, p) lower Cholesky factor of I + dt k S
    trial: Array  # (p, p) scratch
    L: Array  # (p, p) scratch
    age: Array  # (N,) int64, offers since the pair was taken
    quality: Array  # (1,) λ_min(S), zero where S is singular
    gain: float  # dt k
    oldest: int  # the age from which a pair makes way


def build_stack(shape: tuple[int, int, int], gain: float, oldest: int = EMPTY) -> HistoryStack:
    """An empty stack.

    Args:
        shape: pairs, equations a pair, parameters.
        gain: dt k, the period times the learning gain.
        oldest: the age in offers from which a pair makes way for any other.
    """
    size, equations, p = shape
    return HistoryStack(
        Y=np.zeros((size, equations, p)),
        U=np.zeros((size, equations)),
        S=np.zeros((p, p)),
        b=np.zeros(p),
        step=np.eye(p),
        trial=np.zeros((p, p)),
        L=np.zeros((p, p)),
        age=np.full(size, EMPTY),
        quality=np.zeros(1),
        gain=gain,
        oldest=oldest,
    )


@compiled
def offer(stack: HistoryStack, Y: Array, U: Array) -> None:
    """Show the stack a pair Y (m, p), U (m,), for it to keep or not."""
    place = 0
    for k in range(stack.age.size):
        stack.age[k] = min(stack.age[k] + 1, EMPTY)
        if stack.age[k] > stack.age[place]:
            place = k
    if stack.quality[0] > 0.0 and stack.age[place] < stack.oldest:
        place = _best_place(stack, Y)
    if place < 0:
        return
    stack.age[place] = 0
    for e in range(U.size):
        stack.U[place, e] = U[e]
        for i in range(Y.shape[1]):
            stack.Y[place, e, i] = Y[e, i]
    refresh(stack)


@compiled
def learn(stack: HistoryStack, phi: Array) -> None:
    """Advance the estimates phi (p,) by one period."""
    p, L = phi.size, stack.step
    for i in range(p):
        total = phi[i] + stack.gain * stack.b[i]
        for k in range(i):
            total -= L[i, k] * phi[k]
        phi[i] = total / L[i, i]
    for i in range(p - 1, -1, -1):
        total = phi[i]
        for k in range(i + 1, p):
            total -= L[k, i] * phi[k]
        phi[i] = total / L[i, i]


@compiled
def refresh(stack: HistoryStack) -> None:
    """S, b, the step's factor and λ_min, from the pairs; summed anew, so that nothing adds up."""
    size, m, p = stack.Y.shape
    stack.S[:] = 0.0
    stack.b[:] = 0.0
    for k in range(size):
        for e in range(m):
            for i in range(p):
                stack.b[i] += stack.Y[k, e, i] * stack.U[k, e]
                for j in range(p):
                    stack.S[i, j] += stack.Y[k, e, i] * stack.Y[k, e, j]
    for i in range(p):
        for j in range(p):
            stack.trial[i, j] = stack.gain * stack.S[i, j]
    _factor(stack.trial, -1.0, stack.step)
    stack.quality[0] = smallest_eigenvalue(stack.S, stack.L)


@compiled
def smallest_eigenvalue(S: Array, L: Array) -> float:
    """λ_min of a symmetric S (p, p) by bisection, zero where S is singular; L (p, p) is scratch."""
    p = S.shape[0]
    trace, above = 0.0, math.inf
    for i in range(p):
        trace += S[i, i]
        above = min(above, S[i, i])
    below = SINGULAR_BELOW * trace
    if not (trace > 0.0 and _factor(S, below, L)):
        return 0.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (below + above)
        if _factor(S, middle, L):
            below = middle
        else:
            above = middle
    return below


@compiled
def _best_place(stack: HistoryStack, Y: Array) -> int:
    """Where the pair with Y (m, p) raises λ_min(S) most; −1 where it does so nowhere."""
    size, m, p = stack.Y.shape
    place, best = -1, stack.quality[0]
    for k in range(size):
        for i in range(p):
            for j in range(p):
                total = stack.S[i, j]
                for e in range(m):
                    total += Y[e, i] * Y[e, j] - stack.Y[k, e, i] * stack.Y[k, e, j]
                stack.trial[i, j] = total
        # One factorisation tells whether it is better; most places are not.
        if _factor(stack.trial, best, stack.L):
            found = smallest_eigenvalue(stack.trial, stack.L)
            if found > best:
                place, best = k, found
    return place


@compiled
def _factor(S: Array, shift: float, L: Array) -> bool:
    """Cholesky factor L (p, p) of S − shift·I; False where that is not positive definite."""
    p = S.shape[0]
    for i in range(p):
        for j in range(i + 1):
            total = S[i, j] - (shift if i == j else 0.0)
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = total / L[j, j]
            elif total > 0.0:
                L[i, i] = math.sqrt(total)
            else:
                return False
    return True
