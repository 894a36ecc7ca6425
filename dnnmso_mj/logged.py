"""A finished run and its log, whose rows are in memory only as far as they are asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from dnnmso_mj.errors import LogError
from dnnmso_mj.log.blocks import Columns, outline, scan_blocks
from dnnmso_mj.log.scan import Scan
from dnnmso_mj.metrics import BLOCK, block_metrics, compute_metrics, worst_error
from dnnmso_mj.reading import log_info, read_trace
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.trace import RunInfo, StepLayout, Trace

Array = np.ndarray

OUTLINE_BUCKETS = 1_000  # of a long run's figures: one is about as wide as a line


@dataclass(frozen=True)
class LoggedRun:
    """A finished run and its log.

    Args:
        log: of the run.
        scenario: that was run.
        info: how it ended, with its metrics.
        ticks: how many the log holds.
        kept: its columns, of a run of at most `BLOCK` ticks.
    """

    log: Path
    scenario: Scenario
    info: RunInfo
    ticks: int
    kept: Trace | None = field(default=None, repr=False)

    @cached_property
    def trace(self) -> Trace:
        """All columns; those of a long run are read from its log when they are first asked for.

        Raises:
            LogError: the log cannot be read any more, or is another run's by now.
        """
        return self._same(read_trace(self.log)) if self.kept is None else self.kept

    def part(self, *columns: str) -> Trace:
        """Some columns alone.

        Raises:
            LogError: as `trace`.
        """
        if self.kept is not None:
            return self.kept
        parts: list[Columns] = []
        scan = scan_blocks(
            self.log,
            lambda block: parts.append({name: block[name].copy() for name in columns}),
            BLOCK,
        )
        whole = {name: np.concatenate([part[name] for part in parts]) for name in columns}
        return self._same(scan.trace(whole))

    def drawn(self) -> Trace:
        """What figures need of it: of a long run the ticks that its outline is made of.

        Raises:
            LogError: as `trace`.
        """
        return self._same(_outline(self.log, self.ticks)) if self.kept is None else self.kept

    def _same(self, found: Trace) -> Trace:
        if (found.scenario, found.info) != (self.scenario, self.info):
            raise LogError(f"{self.log}: is another run's by now. Run the scenario again")
        return found


def judge(
    log: Path,
    scenario: Scenario,
    layout: StepLayout,
    info: RunInfo,
    ticks: int,
    readable: Path | None = None,
) -> LoggedRun:
    """Compute the metrics of what a log holds, which has all of its rows but not its end yet.

    Args:
        log: of the run.
        scenario, layout: of the run.
        info: how it ended.
        ticks: that the log holds.
        readable: where it can be read meanwhile, if not at `log`.

    Raises:
        LogError: the log cannot be read, or holds another number of ticks.
    """
    place = readable or log
    if ticks > BLOCK:
        return _judge_long(log, place, ticks, scenario, info)
    if ticks:
        trace = read_trace(place)
    else:  # ended before its first row
        trace = Trace(layout.columns(np.empty((0, layout.width))), scenario, info)
    _check(log, len(trace), ticks)
    trace = replace(trace, info=_with_provenance(info, trace.info))
    info = replace(trace.info, metrics=compute_metrics(trace))
    return LoggedRun(log, scenario, info, ticks, replace(trace, info=info))


def _judge_long(log: Path, place: Path, ticks: int, scenario: Scenario, info: RunInfo) -> LoggedRun:
    scans: list[Scan] = []

    def each(take: Callable[[Columns], None]) -> None:
        scans[:] = [scan_blocks(place, take, BLOCK)]
        _check(log, scans[0].ticks, ticks)

    metrics = block_metrics(each, ticks, info.status)
    info = _with_provenance(info, scans[0].run())
    return LoggedRun(log, scenario, replace(info, metrics=metrics), ticks)


def read_drawn(log: Path) -> Trace:
    """What figures need of a log: all of a short one, of a long one its outline.

    Raises:
        LogError: the file is no log of this package, or holds not one tick.
    """
    ticks = log_info(log).ticks
    return read_trace(log) if ticks <= BLOCK else _outline(log, ticks)


def _outline(log: Path, ticks: int) -> Trace:
    scan, columns = outline(log, ticks, _Drawn().signals, OUTLINE_BUCKETS)
    return scan.trace(columns)


class _Drawn:
    """What figures show of columns that come in turn."""

    def __init__(self) -> None:
        self._change: Array | None = None
        self._bound = 0.0

    def signals(self, columns: Columns) -> Array:
        """Lines whose smallest and largest values must be seen; (m, k) of m ticks."""
        self._pair(columns)
        return _lines(columns)

    def _pair(self, columns: Columns) -> None:
        """Hold the bound on the gradient's change for as long as the change, which is sampled.

        Otherwise the bound of one tick would be drawn over the change of another.
        """
        change, bound = columns["gradient_change"], columns["drt_bound"]
        before = np.zeros_like(change[:1]) if self._change is None else self._change
        fresh = np.any(np.diff(change, axis=0, prepend=before) != 0.0, axis=1)
        last = np.maximum.accumulate(np.where(fresh, np.arange(len(fresh)), -1))
        columns["drt_bound"] = np.where(last < 0, self._bound, bound[last])
        self._change, self._bound = change[-1:].copy(), float(columns["drt_bound"][-1])


def _lines(columns: Columns) -> Array:
    names = ("q", "tau", "f_hat", "f_true", "weight_norm", "update_ratio", "eta_bound")
    scalars = ("ultimate_bound", "ultimate_bound_paper", "lyapunov", "compute_us", "saturated")
    error, worst = columns["q"] - columns["q_ref"], worst_error(columns)
    f_err = np.linalg.norm(columns["f_true"] - columns["f_hat"], axis=1)
    e_obs = np.linalg.norm(columns["e_obs"], axis=1)
    drawn = [error, worst, f_err, e_obs, *(columns[name] for name in (*names, *scalars))]
    return np.column_stack(drawn)


def _with_provenance(info: RunInfo, log: RunInfo) -> RunInfo:
    return replace(info, versions=log.versions, git_commit=log.git_commit)


def _check(log: Path, found: int, ticks: int) -> None:
    if found != ticks:
        raise LogError(f"{log}: holds {found} ticks of {ticks} that it was given. Run it again")
