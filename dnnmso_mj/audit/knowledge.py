"""How much of the plant a model knows, as one number over some states."""

from __future__ import annotations

import numpy as np

from dnnmso_mj.errors import NonFiniteError

Array = np.ndarray


def knowledge(f_true: Array, f_hat: Array) -> float | None:
    """1 − RMS(f_true − f̂)/RMS(f_true).

    1: the model knows all. 0: as good as f̂ = 0, which knows nothing. Negative: worse than nothing.

    Args:
        f_true: true drift accelerations (N, n) rad/s², one row a state.
        f_hat: what the model says of the same states (N, n) rad/s².

    Returns:
        None where f_true is zero at every state, since there is nothing to know.

    Raises:
        NonFiniteError: a value is not finite.
    """
    for name, values in (("f_true", f_true), ("f_hat", f_hat)):
        bad = values[~np.isfinite(values)]
        if bad.size:
            raise NonFiniteError(name, float(bad[0]))
    truth = _root_mean_square(f_true)
    return 1.0 - _root_mean_square(f_true - f_hat) / truth if truth else None


def _root_mean_square(values: Array) -> float:
    """Scaled by the largest, so that no square leaves the range of floating point."""
    largest = float(np.abs(values).max())
    return largest * float(np.sqrt(np.mean((values / largest) ** 2))) if largest else 0.0
