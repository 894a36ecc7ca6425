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
    # Scaled by the largest value of either, so that no square leaves the range of floating point.
    largest = max(float(np.abs(f_true).max()), float(np.abs(f_hat).max()))
    if not f_true.any():
        return None
    truth, error = f_true / largest, (f_true - f_hat) / largest
    return 1.0 - float(np.sqrt(np.mean(error**2) / np.mean(truth**2)))
