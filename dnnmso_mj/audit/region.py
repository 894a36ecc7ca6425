"""Which states a trajectory has visited, and which are beyond.

A state is inside if its angles are in the convex hull of the visited angles, and no joint is faster
than it has been: of velocities the sign does not count, since V(q, q̇) is even in q̇. Distances are
in normalised coordinates: an angle by half its visited range, a velocity by the largest speed.
N.B. a hull in all 2n coordinates would be of no use: a periodic trajectory is a closed line there,
often in a plane, and hardly any other motion stays in its hull.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Array = np.ndarray

CORNERS = 64  # visited angles that stand for all of them
TOLERANCE = 0.02  # of a half range; more than what the hull of so few angles cuts off a circle
LEAST_HALF_RANGE = 0.1  # rad and rad/s, of a coordinate that hardly moved
REACH = 2.0  # half ranges; how far beyond is looked


@dataclass(frozen=True)
class Region:
    """What has been visited.

    Args:
        centre: middle of each angle's range, and zero for velocities (2n,).
        half: half of each angle's range, and the largest speeds (2n,), at least `LEAST_HALF_RANGE`.
        corners: normalised angles (m, n), whose hull is the region's.
    """

    centre: Array
    half: Array
    corners: Array

    @property
    def n_joints(self) -> int:
        """n, the number of joints."""
        return int(self.corners.shape[1])

    @property
    def middle(self) -> Array:
        """A state at rest in the hull of visited angles: their mean (2n,)."""
        n, state = self.n_joints, self.centre.copy()
        state[:n] += self.half[:n] * self.corners.mean(axis=0)
        return state

    def contains(self, states: Array) -> Array:
        """Which of the states (N, 2n) are inside, (N,) of bool."""
        n, z = self.n_joints, (states - self.centre) / self.half
        inside: Array = (np.abs(z) <= 1.0 + TOLERANCE).all(axis=1)
        for k in np.flatnonzero(inside):
            inside[k] = distance_to_hull(z[k, :n], self.corners) <= TOLERANCE
        return inside

    def draw_inside(self, count: int, rng: np.random.Generator) -> Array:
        """States inside (count, 2n): mixtures of n + 1 visited angles, uniform velocities."""
        n = self.n_joints
        chosen = self.corners[rng.integers(len(self.corners), size=(count, n + 1))]
        weights = rng.dirichlet(np.ones(n + 1), size=count)
        angles = np.einsum("kj,kji->ki", weights, chosen)
        z = np.hstack([angles, rng.uniform(-1.0, 1.0, size=(count, n))])
        states: Array = self.centre + self.half * z
        return states

    def draw_outside(self, count: int, rng: np.random.Generator) -> Array:
        """States (count, 2n) uniform in the box of `REACH` half ranges, without those inside."""
        found = np.empty((0, self.centre.size))
        while len(found) < count:
            z = rng.uniform(-REACH, REACH, size=(count, self.centre.size))
            states = self.centre + self.half * z
            found = np.vstack([found, states[~self.contains(states)]])
        return found[:count]


def region_of(states: Array) -> Region:
    """The region that visited states (N, 2n), N at least 1, make."""
    n = states.shape[1] // 2
    angles, speeds = states[:, :n], np.abs(states[:, n:]).max(axis=0)
    low, high = angles.min(axis=0), angles.max(axis=0)
    centre = np.concatenate([(low + high) / 2.0, np.zeros(n)])
    half = np.maximum(np.concatenate([(high - low) / 2.0, speeds]), LEAST_HALF_RANGE)
    some = np.linspace(0, len(states) - 1, min(CORNERS, len(states))).round().astype(int)
    return Region(centre, half, (angles[some] - centre[:n]) / half[:n])


def distance_to_hull(point: Array, corners: Array) -> float:
    """Distance of a point (n,) to the convex hull of corners (m, n), which may be flat.

    min ‖Σ w_k c_k − p‖ over w ≥ 0 with Σ w_k = 1, the sum held by a heavily weighted row.
    """
    from scipy.optimize import nnls

    heavy = 1e4
    A = np.vstack([corners.T, np.full(len(corners), heavy)])
    _, residual = nnls(A, np.append(point, heavy))
    return float(residual)
