"""Where two logs first differ, and by how much."""

from __future__ import annotations

import numpy as np

Array = np.ndarray

CLOCKED = ("compute_us", "wake_late_us")  # columns of the wall clock: never the same twice


def rows_differ(one: Array, other: Array) -> Array:
    """Which of N rows differ in any bit: (N,) of bool; both of the same shape and type."""
    bits = [np.ascontiguousarray(rows).view(f"u{rows.itemsize}") for rows in (one, other)]
    differ: Array = (bits[0] != bits[1]).reshape(len(one), -1).any(axis=1)
    return differ
