"""Row 2: a run that diverged is flagged in every row that it has, and its missing part is no data.

Runs diverge at ticks that are known beforehand: by code from outside that gives a torque that is no
number, by a joint that passes its limit, by gains that no drive can follow. Each row is held
against the same run made alone, whose ticks are looked at one by one.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from dnnmso_mj.comparison.plan import plan_comparison
from dnnmso_mj.comparison.summary import summarise as summarise_comparison
from dnnmso_mj.metrics import WHOLE, compute_metrics
from dnnmso_mj.simulation import simulate
from dnnmso_mj.sweep.local import LocalEngine
from dnnmso_mj.sweep.plan import Plan, plan_sweep
from dnnmso_mj.sweep.run import run_sweep
from dnnmso_mj.sweep.summary import summarise
from dnnmso_mj.sweep.table import METRIC_TYPES, TIMING, read_table
from dnnmso_mj.trace import Trace
from soak.ended import dnnmso
from soak.tally import Form, Tally

OUTSIDE = '''
import numpy as np


class Faulty:
    """A PD law; of one seed in three it gives no number from a tick on that the seed decides."""

    def __init__(self, setup, mode):
        rng = np.random.default_rng(setup.seed)
        self.at = int(rng.integers(0, 200)) if setup.seed % 3 == 1 else -1
        self.mode, self.tick = mode, 0

    def update(self, inputs):
        tau = -574.0 * (inputs.q - inputs.q_ref) - 153.0 * (inputs.qd - inputs.qd_ref)
        if self.tick == self.at:
            tau[0] = {"nan": np.nan, "inf": np.inf, "huge": 1e12}[self.mode]
        self.tick += 1
        return tau
'''
LAW = "controller: {kind: external, python: 'laws.py:Faulty', settings: {mode: nan}}\n"
SHORT = ["duration=0.2"]
# An observer of the printed sign, a joint past its limit in some seeds, gains beyond the drives.
AXES = (
    (["controller.observer.K2=300", *SHORT], ["controller.observer.feedback=stable,as_printed"]),
    (
        ["controller.kind=pd", "imperfections.position_noise=0.02", *SHORT],
        ["safety.qd_max=null,2.5,4.0"],
    ),
    (
        ["controller.kind=no_network", "imperfections.torque_limit=30", "duration=1"],
        ["imperfections.actuator_delay=0.0,0.06", "controller.inversion.K=7.5,150.0"],
    ),
)


def run(form: Form, tally: Tally, folder: Path) -> None:
    """Sweeps, a comparison, and the command line."""
    (folder / "laws.py").write_text(OUTSIDE)
    first = form.seed * 1000
    seeds = range(first, first + form.pick(6, 60))
    flagged = 0
    for number, plan in enumerate(_plans(folder, seeds, form)):
        with tally.case(f"sweep {number}"):
            table = run_sweep(plan, folder / f"{number}.parquet", LocalEngine(2)).table
            flagged += check_table(table, plan, tally)
    with tally.case("comparison"):
        flagged += _compared(folder, list(seeds)[: form.pick(4, 20)], tally)
    with tally.case("command line"):
        _command(folder, first)
    tally.figure("rows that diverged", flagged)


def _plans(folder: Path, seeds: Sequence[int], form: Form) -> list[Plan]:
    outside = folder / "outside.yaml"
    outside.write_text(f"name: outside\nreference: {{kind: sinusoid, phase: [0.0, 1.5]}}\n{LAW}")
    grid = ["controller.settings.mode=nan,inf,huge"]
    plans = [plan_sweep(outside, seeds, SHORT, grid, trust=True)]
    for sets, axes in AXES[: form.pick(2, len(AXES))]:
        plans.append(plan_sweep("paper", list(seeds)[: form.pick(4, 24)], sets, axes))
    return plans


def check_table(table: pa.Table, plan: Plan, tally: Tally) -> int:
    """Hold every row against its run made alone, and the statistics against the rows.

    Returns:
        How many rows diverged.
    """
    rows, flagged = table.to_pylist(), 0
    assert len(rows) == len(plan.points) * len(plan.seeds)
    for k, row in enumerate(rows):
        point = plan.points[k // len(plan.seeds)]
        scenario = point.scenario.model_copy(update={"seed": row["seed"]})
        with tally.case(f"{point.parameters}, seed {row['seed']}"):
            alone = simulate(scenario, point.mjcf, watch=False)
            check_row(row, alone)
            flagged += row["diverged"]
    for point, k in zip(summarise(table, plan), range(len(plan.points)), strict=True):
        with tally.case(f"statistics of {point.parameters}"):
            _check_statistics(point, rows[k * len(plan.seeds) :][: len(plan.seeds)])
    return flagged


def check_row(row: dict[str, Any], alone: Trace) -> None:
    """A row of a table says what its run did, and no more.

    Args:
        row: by column.
        alone: the run, every tick of it.
    """
    lost = has_diverged(alone)
    assert row["diverged"] is lost, f"diverged = {row['diverged']}, the run: {lost}"
    assert row["status"] == ("diverged" if lost else "ok"), row["status"]
    assert bool(row["reason"]) is lost, f"reason: {row['reason']!r}"
    assert row["ticks"] == len(alone), f"{row['ticks']} ticks, the run has {len(alone)}"
    assert (row["ticks"] < alone.scenario.n_ticks) or not lost or "safe stop" in row["reason"]
    for name in WHOLE:
        assert not (lost and row[name] is not None), f"{name} = {row[name]} of a part of a run"
    expected = compute_metrics(alone)
    for name in set(METRIC_TYPES) - set(TIMING):
        assert row[name] == expected[name], f"{name} = {row[name]}, the run: {expected[name]}"
    if lost and len(alone):
        assert row["tau_peak"] == np.abs(alone["tau"]).max()


def has_diverged(trace: Trace) -> bool:
    """Judged by its ticks alone: whether some are missing, or an arm is held or out of range.

    Raises:
        AssertionError: its last ticks are copies of one, which is no data.
    """
    check_tail(trace)
    short = len(trace) < trace.scenario.n_ticks
    return short or trace.info.reason.startswith("safe stop")


def check_tail(trace: Trace) -> None:
    """No state at the end stands for ticks that were never run."""
    q, qd = trace["q"], trace["qd"]
    assert np.isfinite(q).all(), "a state that is not finite"
    stuck = (np.diff(q, axis=0) == 0.0).all(axis=1) & (np.abs(qd[1:]) > 1e-9).any(axis=1)
    assert not stuck.any(), f"a frozen tail from tick {stuck.argmax() + 1}"
    if len(trace) > 1:
        dt = trace.scenario.dt
        moved = np.abs(np.diff(q, axis=0) - 0.5 * dt * (qd[1:] + qd[:-1]))
        far = 0.5 * dt * np.abs(np.diff(qd, axis=0)) + 1e-9
        assert (moved <= far + 1e-6 * np.abs(q[1:])).all(), "angles do not follow velocities"


def _check_statistics(point: Any, rows: list[dict[str, Any]]) -> None:
    good = [row for row in rows if row["status"] == "ok"]
    bad = [row for row in rows if row["status"] != "ok"]
    assert (point.runs, point.ok, point.count("diverged")) == (len(rows), len(good), len(bad))
    assert [failure.seed for failure in point.failures] == [row["seed"] for row in bad]
    for name in ("rmse", "rmse_steady", "tau_peak"):
        values = [row[name] for row in good if row[name] is not None]
        assert point.metrics[name].n == len(values)
        median = float(np.median(values)) if values else None
        assert point.metrics[name].median == median, name


def _compared(folder: Path, seeds: Sequence[int], tally: Tally) -> int:
    """A comparison in which one controller diverges in some seeds."""
    faulty = folder / "faulty.yaml"
    faulty.write_text(LAW)
    names = ("pd", str(faulty))
    plan = plan_comparison("paper", names, seeds, SHORT, trust=True)
    table = run_sweep(plan, folder / "compared.parquet", LocalEngine(2)).table
    flagged = check_table(table, plan, tally)
    expected = [seed for seed in seeds if seed % 3 == 1]
    found = summarise_comparison(table)
    standings = {standing.controller: standing for standing in found.standings}
    lost = standings[str(faulty)]
    assert [failure.seed for failure in lost.failures] == expected, lost.failures
    assert (lost.count("diverged"), standings["pd"].count("diverged")) == (len(expected), 0)
    judged = {"nan": math.nan, "median": lost.metrics["rmse_steady"].median}
    if len(expected) * 2 > len(seeds):
        assert judged["median"] == math.inf
    (pairing,) = found.pairings
    assert pairing.losses >= len(expected), (
        "a run that diverged did not lose against one that ended"
    )
    return flagged


def _command(folder: Path, first: int) -> None:
    """What `dnnmso sweep` prints and writes."""
    out = folder / "command.parquet"
    law = {"kind": "external", "python": "laws.py:Faulty", "settings": {"mode": "inf"}}
    words = ["--set", f"controller={json.dumps(law)}", "--set", SHORT[0], "--trust", "--json"]
    seeds = f"{first}:{first + 6}"
    ended = dnnmso(
        "sweep", "paper", *words, "--seeds", seeds, "--jobs", "2", "--out", out, cwd=folder
    )
    assert "Traceback" not in ended.err
    table, _ = read_table(out)
    rows = table.to_pylist()
    expected = [seed % 3 == 1 for seed in range(first, first + 6)]
    assert [row["diverged"] for row in rows] == expected
    assert [row["status"] for row in rows] == ["diverged" if lost else "ok" for lost in expected]
    assert f"{sum(expected)} of 6 runs diverged or failed" in ended.err, ended.err
    assert ended.status == 0, f"status {ended.status}"
