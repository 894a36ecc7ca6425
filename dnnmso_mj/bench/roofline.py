"""How fast the control step could be on this machine, from what its parts take at full speed.

A step must, for each weight,

- move: read w (forward), read and write w and ḡ² (backward, update);
- divide by a root: g/√ḡ², the fastest of three ways: the exact instructions, the processor's
  estimate with Newton's method as the compiler's fast mathematics has it, and Newton's method from
  a guess by the bits;
- multiply and add: w·a, w·δ, ḡ²'s two, and a polynomial for exp over |x| ≤ η*.

Each part is timed alone, over arrays that lie where the network's would, on one core; the slowest
part is the bound, as if the others took place in its shadow. Calls and latencies are left out, so
it is a lower bound, not a target.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from dnnmso_mj.network import Shape

Array = np.ndarray

IN_L1 = 1024  # elements of an array that surely lies in the first cache
SWEEPS = 32  # over the array in one call, so that the call itself does not count
HORNER = 32  # multiply-adds an element in the measurement
OTHER_FMA = 4  # w·a, w·δ, and two of ḡ² ← (1−β) g² + β ḡ²; g itself and clamps are left out
POLYNOMIAL = {"float32": 5, "float64": 9}  # degree that exp needs for |x| ≤ 0.1
# A first guess of 1/√x is this number less half the bits of x, all as integers; and how many of
# Newton's steps take it to full precision.
GUESS: dict[str, tuple[Any, int]] = {
    "float32": (np.int32(0x5F3759DF), 3),
    "float64": (np.int64(0x5FE6EB50C7B537A9), 4),
}


@dataclass(frozen=True)
class Roofline:
    """The bound of one network in one precision, and the parts that it is made of (µs a step).

    Args:
        exact_root_us: dividing by a root with the exact instructions, whether or not they are the
            fastest way: with them alone, a step takes at least this.
    """

    precision: str
    us: dict[str, float]
    exact_root_us: float

    @property
    def binding(self) -> str:
        """The slowest part."""
        return max(self.us, key=lambda name: self.us[name])

    @property
    def bound_us(self) -> float:
        """What the slowest part takes."""
        return max(self.us.values())


def measure_roofline(shape: Shape, precision: str, quick: bool) -> Roofline:
    """Measure this machine for a network of that shape.

    Args:
        shape: layer sizes.
        precision: "float32" or "float64".
        quick: measure for milliseconds instead of tenths of a second.
    """
    n, repeats = shape.n_weights, 20 if quick else 400
    rng = np.random.default_rng(0)
    w, v = rng.uniform(1.0, 2.0, (2, n)).astype(precision)
    a, b, out = rng.uniform(1.0, 2.0, (3, IN_L1)).astype(precision)
    real, (guess, steps) = a.dtype.type, GUESS[precision]
    bits = b.view(guess.dtype), out.view(guess.dtype)

    def us_a_step(function: Callable[[], object], elements: int) -> float:
        return n * _fastest_ns(function, repeats) / (elements * SWEEPS) * 1e-3

    roots = (
        us_a_step(lambda: _divide_root(a, b, out, SWEEPS), IN_L1),
        us_a_step(lambda: _divide_root_estimated(a, b, out, SWEEPS), IN_L1),
        us_a_step(lambda: _divide_root_newton(a, b, out, *bits, guess, steps, SWEEPS), IN_L1),
    )
    fma = us_a_step(lambda: _horner(a, out, real(0.5), real(0.999), SWEEPS), IN_L1) / HORNER
    us = {
        "moving w and ḡ²": us_a_step(lambda: _move(w, v, real(1.0), SWEEPS), n),
        "divide by a root": min(roots),
        "multiply-add": fma * (OTHER_FMA + POLYNOMIAL[precision]),
    }
    return Roofline(precision, us, exact_root_us=roots[0])


def _fastest_ns(function: Callable[[], object], repeats: int) -> float:
    """The fastest of many calls: a limit is what is possible, not what is usual."""
    function()
    best = math.inf
    for _ in range(repeats):
        began = time.perf_counter_ns()
        function()
        best = min(best, time.perf_counter_ns() - began)
    return best


@njit(cache=True, fastmath=True)
def _move(w: Array, v: Array, one: float, sweeps: int) -> float:
    total: float = w.dtype.type(0.0)
    for _ in range(sweeps):
        for i in range(w.size):
            total += w[i]
        for i in range(w.size):
            w[i] *= one
            v[i] *= one
    return total


# In the next three each sweep takes the last one's result, or the compiler might leave sweeps out.
@njit(cache=True, error_model="numpy")
def _divide_root(a: Array, b: Array, out: Array, sweeps: int) -> None:
    for _ in range(sweeps):
        for i in range(a.size):
            out[i] = a[i] / math.sqrt(b[i])
        b, out = out, b


@njit(cache=True, error_model="numpy", fastmath=True)
def _divide_root_estimated(a: Array, b: Array, out: Array, sweeps: int) -> None:
    for _ in range(sweeps):
        for i in range(a.size):
            out[i] = a[i] / math.sqrt(b[i])
        b, out = out, b


@njit(cache=True, fastmath={"contract"})
def _divide_root_newton(
    a: Array,
    b: Array,
    out: Array,
    b_bits: Array,
    out_bits: Array,
    guess: int,
    steps: int,
    sweeps: int,
) -> None:
    """Likewise; the bits are those of b and out as integers."""
    half, three_halves = a.dtype.type(0.5), a.dtype.type(1.5)
    for _ in range(sweeps):
        for i in range(a.size):
            out_bits[i] = guess - (b_bits[i] >> 1)
        for i in range(a.size):
            y, h = out[i], half * b[i]
            y *= three_halves - h * y * y
            y *= three_halves - h * y * y
            y *= three_halves - h * y * y
            if steps > 3:
                y *= three_halves - h * y * y
            out[i] = a[i] * y
        b, out, b_bits, out_bits = out, b, out_bits, b_bits


@njit(cache=True, fastmath={"contract"})
def _horner(a: Array, out: Array, x: float, shrink: float, sweeps: int) -> None:
    for _ in range(sweeps):
        x *= shrink
        for i in range(a.size):
            p = a[i]
            for _ in range(HORNER):
                p = p * x + a[i]
            out[i] = p
