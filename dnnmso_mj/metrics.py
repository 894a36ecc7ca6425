"""What a run is judged by: pure functions of its trace, of the true state, never the measured one.

"Steady" is the last half of what was run: the ticks k >= N//2.
"""

from __future__ import annotations

import numpy as np

from dnnmso_mj.trace import Array, Trace

Metrics = dict[str, float | int | bool | None]

SETTLING_BAND = 0.02  # of the largest error of the first half
SETTLING_DWELL = 0.1  # of the run: an error that merely crosses zero at the end has not settled
BOUND_MARGIN = 1.01  # the bound is of continuous time, the loop is sampled
BOUND_ROUNDING = 1e-9  # rad

# What a run must have come to its end for.
WHOLE = (
    "rmse",
    "rmse_steady",
    "max_abs_error_steady",
    "tau_chatter",
    "f_err_rms_steady",
    "settling_time",
)


def compute_metrics(trace: Trace) -> Metrics:
    """All metrics of a run; the names are a contract with `--json`, sweeps and logs.

    Args:
        trace: the run, of N ticks and n joints.

    Returns:
        rmse: root of the mean square of q - q_ref over all ticks and joints (rad).
        rmse_steady: the same over the last half (rad).
        max_abs_error_steady: largest |q_i - q_ref,i| of the last half (rad).
        tau_peak: largest |tau_i| applied (N·m).
        tau_chatter: mean |tau_i(k+1) - tau_i(k)| over joints and the last half (N·m a step).
        f_err_rms_steady: root of the mean square of f_true - f_hat over all 2n rows of the last
            half (rad/s and rad/s²).
        settling_time: see `settling_time` (s).
        bound_violations: see `bound_violations` (ticks).
        diverged: whether the run was stopped because it left the plausible range, or a limit of
            its joints.
        compute_us_p50, compute_us_p999: percentiles 50 and 99.9 of the controller's time (µs).
        deadline_misses: ticks without a command in time, whatever the cause; see `timing`.

        None stands for what is not defined: too few ticks, or a column that is not finite; and for
        every mean, steady value and settling of a run that diverged, in `WHOLE`, since the part
        that was run is no smaller run. Largest values and counts are of the ticks that there are.
    """
    found = _of_what_was_run(trace)
    lost = WHOLE if found["diverged"] else ()
    return found | dict.fromkeys(lost)


def _of_what_was_run(trace: Trace) -> Metrics:
    half = len(trace) // 2
    error = trace["q"] - trace["q_ref"]
    f_err = trace["f_true"][half:] - trace["f_hat"][half:]
    tau = trace["tau"]
    return {
        "rmse": _root_mean_square(error),
        "rmse_steady": _root_mean_square(error[half:]),
        "max_abs_error_steady": _largest(error[half:]),
        "tau_peak": _largest(tau),
        "tau_chatter": _mean(np.abs(np.diff(tau[half:], axis=0))),
        "f_err_rms_steady": _root_mean_square(f_err),
        "settling_time": settling_time(trace),
        "bound_violations": bound_violations(trace),
        "diverged": trace.info.status == "diverged",
        "compute_us_p50": _percentile(trace["compute_us"], 50.0),
        "compute_us_p999": _percentile(trace["compute_us"], 99.9),
        "deadline_misses": int(np.count_nonzero(trace["deadline_missed"])),
    }


def settling_time(trace: Trace) -> float | None:
    """The 2 % settling time (s): when max_i |q_i - q_ref,i| enters its band for good.

    The band is 2 % of the largest error of the first half: for a step that is the usual 2 % of the
    step, and a run that starts on its reference still has one. None when the error is not in the
    band for at least the last tenth of the run, and for a run that diverged.
    """
    if len(trace) == 0 or trace.info.status == "diverged":
        return None
    error = worst_error(trace)
    band = SETTLING_BAND * error[: max(1, len(trace) // 2)].max()
    outside = np.flatnonzero(~(error <= band))  # so a NaN is outside
    first = int(outside[-1]) + 1 if outside.size else 0
    if first >= len(trace) or len(trace) - first < SETTLING_DWELL * len(trace):
        return None
    return float(trace["t"][first])


def bound_violations(trace: Trace) -> int | None:
    """Ticks at which max_i |q_i - q_ref,i| exceeds that tick's logged ultimate bound.

    A margin of 1 % and 1e-9 rad is left for the sampled loop and for rounding. Ticks whose bound is
    negative have none; None when no tick has one.
    """
    bound = trace["ultimate_bound"]
    defined = bound >= 0.0
    if not defined.any():
        return None
    within = worst_error(trace) <= BOUND_MARGIN * bound + BOUND_ROUNDING  # a NaN is not
    return int(np.count_nonzero(defined & ~within))


def worst_error(trace: Trace) -> Array:
    """max_i |q_i - q_ref,i| of every tick (rad), shape (N,)."""
    worst: Array = np.abs(trace["q"] - trace["q_ref"]).max(axis=1)
    return worst


def _root_mean_square(values: Array) -> float | None:
    """sqrt(mean v²), scaled by the largest so that the squares of a blow-up do not overflow."""
    largest = _largest(values)
    if not largest:
        return largest
    return float(largest * np.sqrt(np.mean((values / largest) ** 2)))


def _largest(values: Array) -> float | None:
    return _finite(np.max(np.abs(values))) if values.size else None


def _mean(values: Array) -> float | None:
    return _finite(np.mean(values)) if values.size else None


def _percentile(values: Array, percent: float) -> float | None:
    return _finite(np.percentile(values, percent)) if values.size else None


def _finite(value: np.floating) -> float | None:
    return float(value) if np.isfinite(value) else None
