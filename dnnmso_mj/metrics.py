"""What a run is judged by: pure functions of its trace, of the true state, never the measured one.

"Steady" is the last half of what was run: the ticks k >= N//2.

A run is gone through in blocks, twice, so that memory does not grow with it, but for 8 bytes a tick
that the percentiles take. A log is gone through in the same blocks: its metrics are those of its
trace, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from dnnmso_mj.trace import Array, Trace

Metrics = dict[str, float | int | bool | None]
Block = Mapping[str, Array]  # columns of some ticks
Each = Callable[[Callable[[Block], None]], None]  # gives all blocks of a run to a function, in turn

BLOCK = 65_536  # ticks
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
    return block_metrics(_blocks_of(trace), len(trace), trace.info.status)


def _blocks_of(trace: Trace) -> Each:
    def each(take: Callable[[Block], None]) -> None:
        for first in range(0, len(trace), BLOCK):
            take({name: column[first : first + BLOCK] for name, column in trace.columns.items()})

    return each


def block_metrics(each: Each, n_ticks: int, status: str) -> Metrics:
    """`compute_metrics` of a run that need not be in memory.

    Args:
        each: gives its columns, in blocks of `BLOCK` ticks and the rest; called more than once.
        n_ticks: N.
        status: as `RunInfo` has it.
    """
    extremes = _Extremes(n_ticks)
    each(extremes.take)
    sums = _Sums(n_ticks, extremes)
    each(sums.take)
    p50, p999 = _percentiles(extremes.compute_us)
    found: Metrics = {
        "rmse": sums.error.root_mean_square(),
        "rmse_steady": sums.error_steady.root_mean_square(),
        "max_abs_error_steady": extremes.error_steady.value(),
        "tau_peak": extremes.tau.value(),
        "tau_chatter": sums.chatter.mean(),
        "f_err_rms_steady": sums.f_err.root_mean_square(),
        "settling_time": sums.settling_time(),
        "bound_violations": extremes.violations if extremes.bounded else None,
        "diverged": status == "diverged",
        "compute_us_p50": p50,
        "compute_us_p999": p999,
        "deadline_misses": extremes.misses,
    }
    return found | dict.fromkeys(WHOLE if found["diverged"] else ())


def settling_time(trace: Trace) -> float | None:
    """The 2 % settling time (s): when max_i |q_i - q_ref,i| enters its band for good.

    The band is 2 % of the largest error of the first half: for a step that is the usual 2 % of the
    step, and a run that starts on its reference still has one. None when the error is not in the
    band for at least the last tenth of the run, and for a run that diverged.
    """
    found = compute_metrics(trace)["settling_time"]
    return None if found is None else float(found)


def bound_violations(trace: Trace) -> int | None:
    """Ticks at which max_i |q_i - q_ref,i| exceeds that tick's logged ultimate bound.

    A margin of 1 % and 1e-9 rad is left for the sampled loop and for rounding. Ticks whose bound is
    negative have none; None when no tick has one.
    """
    found = compute_metrics(trace)["bound_violations"]
    return None if found is None else int(found)


def worst_error(columns: Block | Trace) -> Array:
    """max_i |q_i - q_ref,i| of every tick (rad), shape (N,)."""
    worst: Array = np.abs(columns["q"] - columns["q_ref"]).max(axis=1)
    return worst


class _Largest:
    """The largest |value| of many."""

    def __init__(self) -> None:
        self._of_blocks: list[float] = []

    def take(self, values: Array) -> None:
        if values.size:
            self._of_blocks.append(float(np.max(np.abs(values))))

    def value(self) -> float | None:
        return _finite(np.max(self._of_blocks)) if self._of_blocks else None


class _Mean:
    """The mean of many values, or the root of that of their squares.

    Args:
        largest: |value|, which squares are scaled by, so that those of a blow-up do not overflow.
    """

    def __init__(self, largest: float | None = None) -> None:
        self._largest, self._sum, self._count = largest, 0.0, 0

    def take(self, values: Array) -> None:
        self._sum, self._count = self._sum + float(np.sum(values)), self._count + values.size

    def take_squares(self, values: Array) -> None:
        if self._largest:
            self.take((values / self._largest) ** 2)

    def mean(self) -> float | None:
        return _finite(np.float64(self._sum / self._count)) if self._count else None

    def root_mean_square(self) -> float | None:
        if not self._largest:
            return self._largest
        return float(self._largest * np.sqrt(self._sum / self._count))


class _Steady:
    """How many ticks of a block are of the first half."""

    def __init__(self, n_ticks: int) -> None:
        self._left = n_ticks // 2

    def take(self, block: Block) -> int:
        first = min(self._left, len(block["t"]))
        self._left -= first
        return first


class _Extremes:
    """The first pass: what is counted, and the largest values, which the second one scales by."""

    def __init__(self, n_ticks: int) -> None:
        self.error, self.error_steady, self.tau, self.f_err = (_Largest() for _ in range(4))
        self.compute_us = np.empty(n_ticks)
        self.violations = self.misses = 0
        self.bounded = False
        self._begin = _Largest()  # the error of the first half, of one tick at least
        self._half, self._done = _Steady(n_ticks), 0

    @property
    def band(self) -> float:
        """That an error must stay in to have settled (rad)."""
        largest = self._begin.value()
        return np.nan if largest is None else SETTLING_BAND * largest

    def take(self, block: Block) -> None:
        error, worst, half = block["q"] - block["q_ref"], worst_error(block), self._half.take(block)
        self.error.take(error)
        self.error_steady.take(error[half:])
        self._begin.take(worst[: max(half, 1 if self._done == 0 else 0)])
        self.tau.take(block["tau"])
        self.f_err.take(_f_err(block, half))
        bound = block["ultimate_bound"]
        defined = bound >= 0.0
        within = worst <= BOUND_MARGIN * bound + BOUND_ROUNDING  # a NaN is not
        self.bounded = self.bounded or bool(defined.any())
        self.violations += int(np.count_nonzero(defined & ~within))
        self.misses += int(np.count_nonzero(block["deadline_missed"]))
        self.compute_us[self._done : self._done + len(worst)] = block["compute_us"]
        self._done += len(worst)


class _Sums:
    """The second pass: sums, and when the error has settled."""

    def __init__(self, n_ticks: int, extremes: _Extremes) -> None:
        self.error = _Mean(extremes.error.value())
        self.error_steady = _Mean(extremes.error_steady.value())
        self.f_err = _Mean(extremes.f_err.value())
        self.chatter = _Mean()
        self._band, self._n_ticks = extremes.band, n_ticks
        self._half, self._done = _Steady(n_ticks), 0
        self._last_tau: Array | None = None  # of the steady ticks so far
        self._settled: tuple[int, float] | None = None  # tick and t

    def take(self, block: Block) -> None:
        error, half = block["q"] - block["q_ref"], self._half.take(block)
        self.error.take_squares(error)
        self.error_steady.take_squares(error[half:])
        self.f_err.take_squares(_f_err(block, half))
        self._take_tau(block["tau"][half:])
        outside = np.flatnonzero(~(worst_error(block) <= self._band))  # so a NaN is outside
        if outside.size:
            self._settled = None
        within = int(outside[-1]) + 1 if outside.size else 0
        if self._settled is None and within < len(block["t"]):
            self._settled = self._done + within, float(block["t"][within])
        self._done += len(block["t"])

    def _take_tau(self, tau: Array) -> None:
        if not len(tau):
            return
        before = tau[:0] if self._last_tau is None else self._last_tau
        self.chatter.take(np.abs(np.diff(tau, axis=0, prepend=before)))
        self._last_tau = tau[-1:].copy()

    def settling_time(self) -> float | None:
        """See the function of that name."""
        if self._settled is None:
            return None
        tick, t = self._settled
        return t if self._n_ticks - tick >= SETTLING_DWELL * self._n_ticks else None


def _f_err(block: Block, first: int) -> Array:
    f_err: Array = block["f_true"][first:] - block["f_hat"][first:]
    return f_err


def _percentiles(values: Array) -> tuple[float | None, float | None]:
    """Percentiles 50 and 99.9 of values (N,), which are put in another order."""
    if not values.size:
        return None, None
    p50, p999 = np.percentile(values, [50.0, 99.9], overwrite_input=True)
    return _finite(p50), _finite(p999)


def _finite(value: np.floating) -> float | None:
    return float(value) if np.isfinite(value) else None
