"""Real-time runs that do not get their machine; and what the accounts of them must find."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from soak import accounts
from soak.overload import recovery
from soak.proof import prove

from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.realtime import real_time_pace
from dnnmso_mj.simulation import Simulation
from dnnmso_mj.tick import START_NS
from dnnmso_mj.trace import Trace

PERIOD = 5_000_000


@pytest.mark.alone
def test_misses_are_counted_guarded_and_got_over(tmp_path: Path) -> None:
    """A machine that is busy with something else lets no recovery be seen, and the row says so."""
    prove(12, tmp_path, may_be_left_out=("recovery at ordinary priority",))


@pytest.fixture(scope="module")
def hung(make_scenario, two_link: Mjcf) -> tuple[Trace, int]:
    """A run that hung for 60 ms, and when it began."""
    stalls = {"watchdog": "damped", "damping": 3.0, "stalls": [{"at": 0.2, "duration": 0.06}]}
    kind = {"kind": "no_network"}
    scenario = make_scenario(kind, duration=0.5, dt=0.005, real_time=stalls)
    simulation = Simulation(scenario, two_link, pace=real_time_pace(scenario))
    recorder = MemoryRecorder(simulation.layout, scenario.n_ticks)
    info = simulation.run(recorder)
    return recorder.trace(scenario, info), int(simulation.stage.world.counts[START_NS])


def changed(trace: Trace, name: str, values: np.ndarray) -> Trace:
    """The same run with another column."""
    columns = {key: np.array(trace[key]) for key in trace}
    return replace(trace, columns=columns | {name: values})


def wrong(trace: Trace, start: int) -> list[str]:
    """All that the accounts find in a run of 100 ticks that stood still in ticks 41 to 50."""
    window = (start + 41 * PERIOD, start + 51 * PERIOD)
    return (
        accounts.lost_ticks(trace, 100, 0.005)
        + accounts.against_itself(trace, PERIOD)
        + accounts.against_windows(trace, [window], start, PERIOD)
        + accounts.against_watchdog(trace, "damped", 3.0)[0]
    )


def test_a_truthful_log_agrees_with_every_account(hung: tuple[Trace, int]) -> None:
    trace, start = hung
    assert np.count_nonzero(trace["deadline_missed"]) >= 12
    assert wrong(trace, start) == []


def test_a_log_whose_flags_were_cleared_is_found_out(hung: tuple[Trace, int]) -> None:
    trace, start = hung
    flags = trace["deadline_missed"]
    found = " ".join(wrong(changed(trace, "deadline_missed", np.zeros_like(flags)), start))
    for said in ("late and not flagged", "woke after", "stood still", "events", "another torque"):
        assert said in found, said
    one = np.array(flags)
    one[45] = False
    assert wrong(changed(trace, "deadline_missed", one), start)


def test_a_log_that_shows_more_or_less_than_there_was_is_found_out(hung) -> None:
    trace, start = hung
    flags = np.array(trace["deadline_missed"])
    flags[np.flatnonzero(flags == 0)[0]] = True
    assert wrong(changed(trace, "deadline_missed", flags), start)
    for name in ("wake_late_us", "compute_us"):
        assert wrong(changed(trace, name, np.zeros_like(trace[name])), start), name
    assert wrong(changed(trace, "tau", np.roll(trace["tau"], 1, axis=0)), start)
    assert wrong(changed(trace, "t", np.roll(trace["t"], 1)), start)
    short = replace(trace, columns={key: trace[key][:99] for key in trace})
    assert accounts.lost_ticks(short, 100, 0.005) == ["99 ticks in the log instead of 100"]


def test_a_stamped_tick_that_was_late_must_be_flagged_and_no_other(hung) -> None:
    trace, start = hung
    due = start + PERIOD * np.arange(100)
    missed = np.array(trace["deadline_missed"])
    ready = np.where(missed, due + PERIOD + 1000, due + 2000)
    control = trace["compute_us"] > 0
    stamps = np.stack([due, np.where(control, due, due + PERIOD), ready, ready + 100], axis=1)
    assert accounts.against_stamps(trace, stamps, start, PERIOD) == ([], 0)
    for flag, shift, said in (
        (1, -PERIOD, "in time and are flagged"),
        (0, PERIOD, "came late and are not flagged"),
    ):
        other = stamps.copy()
        other[np.flatnonzero(missed == flag)[0], 2:] += shift
        assert said in accounts.against_stamps(trace, other, start, PERIOD)[0][0]


@pytest.mark.parametrize(
    ("n_ticks", "part", "lost"), [(1500, 0.02, 0), (1500, 0.04, 1), (490, 0.02, 0), (490, 0.04, 1)]
)
def test_deadlines_still_missed_after_a_load_are_lost(n_ticks: int, part: float, lost: int) -> None:
    t = np.arange(4000) / 1000
    missed = np.zeros(4000, bool)
    missed[700 + np.linspace(0, n_ticks - 1, round(part * n_ticks)).astype(int)] = True
    trace = cast(Trace, {"t": t, "deadline_missed": missed})
    loads = [(0.1, 0.4), (0.7 + n_ticks / 1000 + 0.01, 3.9)]
    assert len(recovery(trace, loads, 0.0)) == lost
