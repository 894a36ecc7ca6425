"""Experience to learn from again: states, and what the dynamics were there.

The memory covers the states that were visited, not only the last seconds: the state space is cut
into cells, and each cell keeps the newest pair that fell into it. When there is no room for another
cell, the one that was not visited for longest is given up.

A trajectory is a curve, and on a curve q and q̇ go together: nothing there tells a network which of
the two the dynamics depend on, and what it makes up can undo the damping of the feedback. So a
remembered state is replayed with a small displacement, and the same label: the model is held flat in
all directions that the labels do not speak of (training with noise is Tikhonov regularisation:
Bishop 1995). Entries and displacements go by an additive recurrence of low discrepancy (Roberts
2018), which needs no random numbers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dnnmso_mj.compiling import compiled, copy

Array = np.ndarray

# Slots of `Memory.counts`.
SIZE, CLOCK = range(2)


class Memory(NamedTuple):
    """Pairs of a state and a label."""

    x: Array  # (capacity, 2n)
    label: Array  # (capacity, n)
    cell: Array  # (capacity,) int64, a hash of the cell that each is of
    stored: Array  # (capacity,) int64, when each was stored, by the memory's own count
    counts: Array  # (2,) int64: entries, and pairs ever seen
    phase: Array  # (1 + 2n,) in [0, 1): where replay stands, entry and displacement
    step: Array  # (1 + 2n,) of the phase
    spread: Array  # (2n,) largest displacement
    recalled: Array  # (2n,) the last one replayed, displaced
    spacing: float  # side of a cell


def build_memory(
    capacity: int, n_joints: int, spacing: float, position_spread: float, velocity_spread: float
) -> Memory:
    """An empty memory of pairs (2n,) and (n,)."""
    n = n_joints
    return Memory(
        x=np.zeros((capacity, 2 * n)),
        label=np.zeros((capacity, n)),
        cell=np.zeros(capacity, np.int64),
        stored=np.zeros(capacity, np.int64),
        counts=np.zeros(2, np.int64),
        phase=np.zeros(1 + 2 * n),
        step=_recurrence(1 + 2 * n),
        spread=np.repeat([position_spread, velocity_spread], n),
        recalled=np.zeros(2 * n),
        spacing=spacing,
    )


def _recurrence(size: int) -> Array:
    """The steps g⁻¹, g⁻², … with g^(size + 1) = g + 1, the golden ratio for one dimension."""
    g = 2.0
    for _ in range(64):
        g = (1.0 + g) ** (1.0 / (size + 1))
    return g ** -np.arange(1.0, size + 1)


def memory_state(memory: Memory) -> dict[str, Array]:
    """Everything in the memory, as arrays of a controller's state."""
    return {f"memory_{name}": getattr(memory, name).copy() for name in _ARRAYS}


def restore_memory(memory: Memory, state: Mapping[str, Array]) -> None:
    """Put a `memory_state` back."""
    for name in _ARRAYS:
        getattr(memory, name)[:] = state[f"memory_{name}"]


_ARRAYS = ("x", "label", "cell", "stored", "counts", "phase")


@compiled
def remember(memory: Memory, x: Array, label: Array) -> None:
    """Keep the label (n,) of a state x (2n,)."""
    size = memory.counts[SIZE]
    cell = _cell(x, memory.spacing)
    at = _find(memory.cell, size, cell)
    if at == size:
        if size == len(memory.cell):
            at = _oldest(memory.stored)
        else:
            memory.counts[SIZE] = size + 1
    copy(x, memory.x[at])
    copy(label, memory.label[at])
    memory.counts[CLOCK] += 1
    memory.cell[at], memory.stored[at] = cell, memory.counts[CLOCK]


@compiled
def _cell(x: Array, spacing: float) -> int:
    """A hash of the cell of x: two cells may share one, and then they share their place."""
    code = 0
    for value in x:
        code = code * 1_000_003 + int(math.floor(value / spacing))
    return code


@compiled
def _find(cells: Array, size: int, cell: int) -> int:
    """Where a cell is kept; `size` where it is not."""
    for i in range(size):
        if cells[i] == cell:
            return i
    return size


@compiled
def _oldest(stored: Array) -> int:
    at = 0
    for i in range(stored.size):
        if stored[i] < stored[at]:
            at = i
    return at


@compiled
def recall(memory: Memory) -> int:
    """The entry to replay next, its state displaced in `recalled`; there must be one."""
    for j in range(memory.phase.size):
        memory.phase[j] = (memory.phase[j] + memory.step[j]) % 1.0
    at = int(memory.phase[0] * memory.counts[SIZE])
    for j in range(memory.recalled.size):
        off = memory.spread[j] * (2.0 * memory.phase[1 + j] - 1.0)
        memory.recalled[j] = memory.x[at, j] + off
    return at
