"""What a run is remembered by: one row of numbers a tick, and the columns made of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from dnnmso_mj.scenario import Scenario

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    from matplotlib.figure import Figure

    from dnnmso_mj.metrics import Metrics

Array = np.ndarray

FLAGS = ("saturated", "clipped", "deadline_missed")
SCALARS = (
    "t",
    "drt_bound",
    "lyapunov",
    "ultimate_bound",
    "ultimate_bound_paper",
    "compute_us",
    "wake_late_us",
)


@dataclass(frozen=True)
class StepLayout:
    """Names, order and widths of the columns of one tick.

    Args:
        n_joints: n, the number of joints.
        n_layers: number of weight layers of the controller's network; 0 without a network.
    """

    n_joints: int
    n_layers: int

    @property
    def widths(self) -> dict[str, int]:
        """Field name -> number of doubles, in the order of the log's protobuf fields."""
        n, layers = self.n_joints, self.n_layers
        return {
            "t": 1,  # s
            "q": n,  # rad, true state at t_k
            "qd": n,  # rad/s
            "q_meas": n,  # rad, what the sensors said
            "qd_meas": n,  # rad/s
            "q_ref": n,  # rad
            "qd_ref": n,  # rad/s
            "tau_cmd": n,  # N·m, what the controller asked for
            "tau": n,  # N·m, applied from t_k to t_k+1
            "x_hat": 2 * n,  # observer state
            "f_hat": 2 * n,  # learned dynamics
            "f_true": 2 * n,  # Ẋ − B τ, the dynamics the network should learn
            "e_obs": 2 * n,  # e_a = X − X̂
            "weight_norm": layers,  # ‖W_l‖_F
            "update_ratio": layers,  # ‖ΔW_l‖_F / ‖W_l‖_F of this tick
            "eta_bound": layers,  # Theorem 1: descent is guaranteed for η below it
            "gradient_change": layers,  # ‖g_l(W+ΔW) − g_l(W)‖ / ‖g_l(W)‖, sampled and held
            "drt_bound": 1,  # deep relative trust: what bounds gradient_change
            "lyapunov": 1,  # L = e_rᵀ e_r
            "ultimate_bound": 1,  # rad, on each |e_i|, for the loop that is really closed
            "ultimate_bound_paper": 1,  # on ‖e_r‖, as the paper states it
            "compute_us": 1,  # µs, wall time of the controller's update
            "saturated": 1,  # flags, 0 or 1
            "clipped": 1,
            "deadline_missed": 1,
            "wake_late_us": 1,  # µs, how late the tick began by the wall clock; 0 where not paced
        }

    @property
    def width(self) -> int:
        """Number of doubles in one row."""
        return sum(self.widths.values())

    @property
    def slices(self) -> dict[str, slice]:
        """Field name -> where it stands in the row."""
        out, start = {}, 0
        for name, width in self.widths.items():
            out[name] = slice(start, start + width)
            start += width
        return out

    def columns(self, rows: Array) -> dict[str, Array]:
        """Split rows (N, width) into columns: vectors (N, k), scalars (N,), flags (N,) of bool."""
        out: dict[str, Array] = {}
        for name, where in self.slices.items():
            column = rows[:, where]
            if name in SCALARS:
                column = column[:, 0]
            elif name in FLAGS:
                column = column[:, 0] != 0.0
            out[name] = column
        return out

    def rows(self, columns: Mapping[str, Array]) -> Array:
        """Columns of N ticks as rows (N, width); zeros where a column is narrower than here."""
        rows = np.zeros((len(columns["t"]), self.width))
        for name, where in self.slices.items():
            column = columns[name].reshape(len(rows), -1)
            rows[:, where.start : where.start + column.shape[1]] = column
        return rows


@dataclass(frozen=True)
class Event:
    """Something worth a line in the log: a divergence, a first saturation, the end of a run."""

    t: float  # s
    level: str  # "info" | "warning" | "error"
    message: str


@dataclass(frozen=True)
class RunInfo:
    """What is known of a run beside its columns."""

    status: str  # "ok" | "diverged" | "interrupted" | "failed" | "unfinished" (torn log)
    seed: int
    wall_s: float = 0.0
    reason: str = ""  # why a run diverged
    versions: Mapping[str, str] = field(default_factory=dict)
    git_commit: str = ""
    metrics: Mapping[str, float | int | bool | None] = field(default_factory=dict)


@dataclass(frozen=True, repr=False)
class Trace:
    """The columns of a run, e.g. ``trace["q"]`` of shape (N, n), with the scenario it came from.

    Examples:
        >>> from dnnmso_mj import load_scenario, simulate
        >>> trace = simulate(load_scenario("paper", ["duration=0.1"], controller="pd"))
        >>> trace["q"].shape  # ticks, joints
        (100, 2)
        >>> trace.table().column_names[:5]
        ['t', 'q1', 'q2', 'qd1', 'qd2']
        >>> round(trace.metrics["tau_peak"])
        287
    """

    columns: Mapping[str, Array]
    scenario: Scenario
    info: RunInfo
    events: tuple[Event, ...] = ()

    def __getitem__(self, name: str) -> Array:
        try:
            return self.columns[name]
        except KeyError:
            names = ", ".join(self.columns)
            raise KeyError(f"{name!r}; a trace has {names}") from None

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        return len(self.columns["t"])

    @property
    def n_joints(self) -> int:
        """n, the number of joints."""
        return int(self.columns["q"].shape[1])

    @property
    def n_layers(self) -> int:
        """Number of weight layers of the controller's network; 0 without one."""
        return int(self.columns["weight_norm"].shape[1])

    @cached_property
    def metrics(self) -> Metrics:
        """What the run is judged by; see `dnnmso_mj.metrics.compute_metrics`."""
        from dnnmso_mj.metrics import compute_metrics

        return compute_metrics(self)

    def table(self) -> pa.Table:
        """All columns as an Arrow table of one column a number.

        A column of vectors is split: `q` of two joints into `q1` and `q2`, `x_hat` into `x_hat1` to
        `x_hat4`. Each field's metadata has its `unit`, the table's the scenario and seed.

        Raises:
            MissingExtraError: pyarrow is not installed.
        """
        from dnnmso_mj.extras import require

        require("sweep", "Trace.table")
        from dnnmso_mj.trace_table import trace_table

        return trace_table(self)

    def to_pandas(self) -> pd.DataFrame:
        """`table` as a pandas data frame, the time `t` (s) as its index.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        from dnnmso_mj.trace_table import trace_frame

        return trace_frame(self)

    def plot(self) -> Figure:
        """Angles, errors and torques in one figure, which a notebook shows by itself.

        Raises:
            DnnmsoError: the run has no tick.
            MissingExtraError: matplotlib is not installed.
        """
        from dnnmso_mj.extras import require

        require("plot", "Trace.plot")
        from dnnmso_mj.plots import overview

        return overview(self)

    def __repr__(self) -> str:
        span = len(self) * self.scenario.dt
        words = [f"{len(self)} ticks, {span:g} s", *(f"{name} {v}" for name, v in self._shown())]
        return f"<Trace of {self._title()}: {', '.join(words)}>"

    def _repr_html_(self) -> str:
        rows = [("ticks", str(len(self))), *self._shown()]
        cells = "".join(f"<tr><th>{name}</th><td>{escape(value)}</td></tr>" for name, value in rows)
        return f"<table><caption>{escape(self._title())}</caption>{cells}</table>"

    def _title(self) -> str:
        return f"{self.scenario.name}, seed {self.info.seed}, {self.info.status}"

    def _shown(self) -> list[tuple[str, str]]:
        """A few metrics in words."""
        units = {"rmse": "rad", "rmse_steady": "rad", "tau_peak": "N·m"}
        found = {name: self.metrics[name] for name in units}
        return [(k, f"{v:.4g} {units[k]}") for k, v in found.items() if v is not None]
