"""Row 1 of the scorecard in its short form, and what its checker must catch."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from soak.faulted import check, check_end, check_rows
from soak.faults import Fault, Struck, run_struck, witness
from soak.non_finite import Job
from soak.proof import prove

from dnnmso_mj.environments.episode import Episode
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.simulation import Simulation, simulate
from dnnmso_mj.trace import Trace

TICK = 120


def test_non_finite(tmp_path: Path) -> None:
    prove(1, tmp_path)


@pytest.fixture(scope="module")
def job() -> tuple[Simulation, Mjcf]:
    mjcf = Mjcf.read(find_model("two_link"))
    return Simulation(Job("dnn_mso", "imperfect", 1, 0).scenario(), mjcf), mjcf


@pytest.fixture(scope="module")
def clean(job: tuple[Simulation, Mjcf], tmp_path_factory: Any) -> Trace:
    return run_struck(*job, None, tmp_path_factory.mktemp("clean") / "run.mcap").run.trace


@pytest.fixture
def struck(job: tuple[Simulation, Mjcf], tmp_path: Path) -> Struck:
    return run_struck(*job, Fault("weights", TICK, np.inf, 0.3), tmp_path / "run.mcap")


def test_an_infinite_weight_ends_the_run_though_its_neuron_only_saturates(
    struck: Struck, clean: Trace
) -> None:
    check(struck, clean)
    assert "weights" in struck.run.trace.info.reason
    assert np.isinf(struck.kept["weights"]).sum() == 1  # it has not been learned away


def test_an_infinite_moment_that_stops_learning_is_found(
    job: tuple[Simulation, Mjcf], clean: Trace, tmp_path: Path
) -> None:
    fault = Fault("optimiser", TICK, np.inf, 0.3)
    struck = run_struck(*job, fault, tmp_path / "run.mcap")
    check(struck, clean)
    assert "second_moment" in struck.run.trace.info.reason


def test_the_checker_misses_nothing(struck: Struck, clean: Trace) -> None:
    """Runs that are wrong in one thing each."""
    later = replace(struck, fault=Fault("weights", TICK + 50, np.inf, 0.3))
    sensor = replace(struck, fault=Fault("force", TICK, np.inf, 0.3))
    seen = replace(struck, seen=replace(struck.seen, bad=["ctrl = [nan]"]))
    jumped = replace(struck, times=[*struck.times[:50], *(t - 0.05 for t in struck.times[50:])])
    kept = replace(struck, kept=struck.kept | {"weights": struck.kept["weights"] + 1.0})
    warned = replace(struck, warnings=1)
    for wrong in (later, sensor, seen, jumped, kept, warned):
        with pytest.raises(AssertionError):
            check(wrong, clean)


def test_rows_that_are_missing_changed_or_held_are_caught(clean: Trace) -> None:
    def with_rows(change: Any) -> Trace:
        return replace(clean, columns={n: change(v.copy()) for n, v in clean.columns.items()})

    check_rows(clean, clean, TICK)
    hole = with_rows(lambda values: np.delete(values, 40, axis=0))
    with pytest.raises(AssertionError, match="a hole in time"):
        check_rows(hole, clean, TICK)
    with pytest.raises(AssertionError, match="ticks; the fault came before"):
        check_rows(with_rows(lambda values: values[:TICK]), clean, TICK + 1)

    def off(values: Any) -> Any:
        if values.ndim == 2:
            values[TICK - 1] = np.nextafter(values[TICK - 1], np.inf)
        return values

    with pytest.raises(AssertionError, match="differs before the fault"):
        check_rows(with_rows(off), clean, TICK)

    def hold(values: Any) -> Any:
        values[TICK:] = values[TICK]
        return values

    with pytest.raises(AssertionError, match="a frozen tail"):
        check_end(with_rows(hold))


def test_the_witness_sees_what_mujoco_is_given() -> None:
    """An unguarded step with a torque that is no number; the warning is MuJoCo's."""
    scenario = load_scenario("paper", ["duration=0.01"], controller="pd")
    simulation = Simulation(scenario, Mjcf.read(find_model("two_link")))
    with witness() as seen:
        mujoco.mj_forward(simulation.plant.model, simulation.plant.data)
        assert (seen.passes, seen.bad) == (1, [])
        simulation.plant.step(np.array([np.nan, 0.0]))
        assert seen.bad
    with witness() as seen:
        simulate(scenario)  # the compiled loop calls it too
        assert seen.passes >= 10
        assert not seen.bad


def test_an_infinite_action_is_no_full_torque() -> None:
    episode = Episode("paper", ("duration=0.1",))
    episode.restart(episode.scenario)
    episode.hold(episode.torque(np.array([np.inf, 0.0])), 1)
    assert episode.over
    assert episode.error == "tau = [inf, 0.0] at t = 0 s"
