"""The memory: a cell keeps its newest pair, the stalest goes, and replay covers all evenly."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import qmc

from dnnmso_mj.memory import (
    CLOCK,
    SIZE,
    build_memory,
    memory_state,
    recall,
    remember,
    restore_memory,
)

SPREAD = (0.01, 0.3)  # rad, rad/s


def memory_of(capacity: int = 50, spacing: float = 0.1, spread=SPREAD, n: int = 2):
    return build_memory(capacity, n, spacing, *spread)


def fill(memory, count: int, seed: int = 0) -> np.ndarray:
    """Remember states (count, 2n) in cells of their own, each labelled by its number."""
    size = memory.x.shape[1]
    rng = np.random.default_rng(seed)
    cells = rng.permutation(40_000)[:count, None] // 20 ** np.arange(size) % 20
    states = (cells + rng.uniform(0.1, 0.9, size=cells.shape)) * memory.spacing
    assert len(np.unique(cells, axis=0)) == count
    for i, x in enumerate(states):
        remember(memory, x, np.full(size // 2, float(i)))
    return states


def kept(memory) -> dict[bytes, tuple[float, ...]]:
    size = memory.counts[SIZE]
    pairs = zip(memory.x[:size], memory.label[:size], strict=True)
    return {x.tobytes(): tuple(label) for x, label in pairs}


def test_a_cell_keeps_its_newest_pair_alone():
    memory = memory_of(spacing=0.1)
    remember(memory, np.array([0.31, 0.0, 0.0, 0.0]), np.array([1.0, 2.0]))
    remember(memory, np.array([0.39, 0.05, 0.0, 0.0]), np.array([3.0, 4.0]))
    assert memory.counts[SIZE] == 1
    assert memory.x[0].tolist() == [0.39, 0.05, 0.0, 0.0]
    assert memory.label[0].tolist() == [3.0, 4.0]
    remember(memory, np.array([0.41, 0.05, 0.0, 0.0]), np.array([5.0, 6.0]))
    assert memory.counts.tolist() == [2, 3]


def test_cells_are_cut_alike_on_both_sides_of_zero():
    memory = memory_of(spacing=0.1)
    for value in (-0.05, 0.05, -0.15):
        remember(memory, np.array([0.0, value, 0.0, 0.0]), np.zeros(2))
    assert memory.counts[SIZE] == 3


def test_the_cell_that_was_not_visited_for_longest_is_given_up():
    memory = memory_of(capacity=3, spacing=1.0)
    at = [np.array([i + 0.5, 0.0, 0.0, 0.0]) for i in range(4)]
    for i in (0, 1, 2, 0, 3):  # 0 is visited again, so 1 is the stalest when 3 wants room
        remember(memory, at[i], np.full(2, float(i)))
    assert sorted(memory.x[:, 0]) == [0.5, 2.5, 3.5]


STATES = st.lists(
    st.tuples(*[st.floats(-2.0, 2.0, allow_subnormal=False)] * 4), min_size=1, max_size=60
)


@settings(max_examples=100, deadline=None)
@given(states=STATES, capacity=st.integers(1, 12), spacing=st.sampled_from([0.02, 0.3, 1.5]))
def test_it_is_a_dictionary_of_cells_in_the_order_of_their_last_visit(states, capacity, spacing):
    memory = memory_of(capacity, spacing)
    expected: dict[tuple[int, ...], tuple[bytes, tuple[float, ...]]] = {}
    for i, state in enumerate(states):
        x, label = np.array(state), np.array([float(i), -float(i)])
        remember(memory, x, label)
        cell = tuple(math.floor(value / spacing) for value in state)
        expected.pop(cell, None)
        if len(expected) == capacity:
            del expected[next(iter(expected))]
        expected[cell] = (x.tobytes(), tuple(label))
    assert kept(memory) == dict(expected.values())
    assert memory.counts[SIZE] == len(expected) <= capacity
    assert memory.counts[CLOCK] == len(states)


def test_no_two_cells_of_a_long_walk_share_a_place():
    """Cells are told apart by a hash; a collision would lose one of them."""
    steps = np.random.default_rng(1).normal(scale=0.03, size=(4000, 4))
    walk = np.cumsum(steps, axis=0)
    memory = memory_of(capacity=5000, spacing=0.02)
    for x in walk:
        remember(memory, x, np.zeros(2))
    cells = np.unique(np.floor(walk / 0.02), axis=0)
    assert memory.counts[SIZE] == len(cells) > 3500


def replayed(memory, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Entries (count,) and displacements (count, 2n), in parts of the spread."""
    entries, offsets = [], []
    for _ in range(count):
        at = recall(memory)
        entries.append(at)
        offsets.append((memory.recalled - memory.x[at]) / memory.spread)
    return np.array(entries), np.array(offsets)


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_a_replayed_state_is_displaced_within_the_spread_to_both_sides(n):
    memory = memory_of(n=n)
    fill(memory, 10)
    entries, offsets = replayed(memory, 5000)
    assert set(entries) == set(range(10))
    assert np.abs(offsets).max() <= 1.0 + 1e-12
    assert np.all(offsets.min(axis=0) < -0.95)
    assert np.all(offsets.max(axis=0) > 0.95)
    assert np.abs(offsets.mean(axis=0)).max() < 0.05
    assert np.array_equal(memory.spread, np.repeat(SPREAD, n))


def test_without_a_spread_the_remembered_state_itself_is_replayed():
    memory = memory_of(spread=(0.0, 0.0))
    states = fill(memory, 7)
    for _ in range(50):
        at = recall(memory)
        assert np.array_equal(memory.recalled, states[at])


@pytest.mark.parametrize("size", [1, 7, 100, 400])
def test_every_entry_is_replayed_equally_often(size):
    memory = memory_of(capacity=400)
    fill(memory, size)
    entries, _ = replayed(memory, 50 * size)
    often = np.bincount(entries, minlength=size)
    assert often.min() >= 40
    assert often.max() <= 60


def test_replay_covers_entries_and_displacements_together_better_than_chance():
    """Centred discrepancy in 5 dimensions: the recurrence's, random points', a grid-like step's."""
    memory = memory_of(capacity=512)
    fill(memory, 512)
    entries, offsets = replayed(memory, 1000)
    points = np.column_stack([(entries + 0.5) / 512, 0.5 + 0.5 * offsets]).clip(0.0, 1.0)
    random = [np.random.default_rng(k).random(points.shape) for k in range(5)]
    found = qmc.discrepancy(points)
    assert found < 0.5 * min(qmc.discrepancy(other) for other in random)
    poor = (np.arange(1000)[:, None] * np.full(5, memory.step[0])) % 1.0
    assert qmc.discrepancy(poor) > 10 * found


def test_steps_are_powers_of_the_generalised_golden_ratio():
    step = memory_of(n=2).step
    g = 1.0 / step[0]
    assert step == pytest.approx(g ** -np.arange(1.0, 6.0), rel=1e-14)
    assert g**6 == pytest.approx(g + 1.0, rel=1e-13)


def test_a_memory_put_back_goes_on_as_the_first_did():
    first, second = memory_of(), memory_of()
    fill(first, 30)
    replayed(first, 11)
    restore_memory(second, memory_state(first))
    for memory in (first, second):
        fill(memory, 40, seed=2)
    one, two = replayed(first, 100), replayed(second, 100)
    assert np.array_equal(one[0], two[0])
    assert np.array_equal(one[1], two[1])
    for name, values in memory_state(first).items():
        assert np.array_equal(values, memory_state(second)[name]), name


def test_its_state_is_a_copy():
    memory = memory_of()
    fill(memory, 3)
    before = memory_state(memory)
    fill(memory, 5, seed=3)
    assert before["memory_counts"].tolist() == [3, 3]
