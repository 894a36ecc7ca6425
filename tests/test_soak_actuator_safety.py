"""Row 3 of the scorecard in its short form, what its checkers must catch, and the safe stop."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from soak.actuator_safety import check_limits, check_stop, fuzz, through
from soak.proof import prove
from soak.tally import Tally

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.scenario import Imperfections
from dnnmso_mj.simulation import simulate
from dnnmso_mj.trace import Trace

Array = np.ndarray
QUIET = pytest.mark.filterwarnings("ignore::dnnmso_mj.loading.ScenarioWarning")


def test_actuator_safety(tmp_path: Path) -> None:
    prove(3, tmp_path)


def leaky(actuators: Any, asked: Array, given: Array, first: int) -> None:
    """Drives that let one unit in the last place through above their limit."""
    through(actuators, asked, given, first)
    most = actuators.limits[0]
    over = np.abs(given) == most
    given[over] = np.nextafter(given, np.inf * np.sign(np.nan_to_num(given)))[over]


def hasty(actuators: Any, asked: Array, given: Array, first: int) -> None:
    """Drives that change a millionth faster than they may."""
    through(actuators, asked, given, first)
    every = np.arange(len(given)) % 2 == 1
    given[every] = np.where(np.isfinite(given[every]), given[every] * (1.0 - 1e-6), np.nan)


def deaf(actuators: Any, asked: Array, given: Array, first: int) -> None:
    """Drives that make a torque of what is no number."""
    through(actuators, asked, given, first)
    given[np.isnan(given)] = 0.0


@pytest.mark.parametrize("drive", [leaky, hasty, deaf])
def test_drives_that_pass_a_limit_are_caught(drive: Any) -> None:
    tally = Tally()
    fuzz(tally, np.random.default_rng(1), 200_000, drive)
    assert tally.lost


def test_the_torque_limit_holds_to_the_last_bit_through_delay_and_lag() -> None:
    spec = Imperfections(torque_limit=0.1, actuator_delay=0.0023, actuator_lag=0.004)
    over = np.full((3, 1), np.nextafter(0.1, 1.0))
    with pytest.raises(AssertionError, match="limit "):
        check_limits(spec, over, over, prompt=False)


def pd(*sets: str) -> Trace:
    return simulate(load_scenario("paper", ["duration=1", *sets], controller="pd"))


@pytest.fixture(scope="module")
def stopped() -> Trace:
    return pd("safety.q_max=0.6")


def test_a_stop_comes_to_rest_where_the_joint_passed_its_limit(stopped: Trace) -> None:
    check_stop(stopped)
    assert stopped.info.reason.endswith("; standing at t = 1.056 s") or len(stopped) == 1000
    assert np.abs(stopped["qd"][-1]).max() < 0.2
    assert abs(stopped["q"][-1, 1] - 0.6) < 0.1


def test_without_limits_nothing_stops() -> None:
    trace = pd()
    check_stop(trace)
    assert trace.info.status == "ok"


@pytest.mark.parametrize(
    "broken",
    [
        lambda trace: replace(trace, info=replace(trace.info, status="ok")),
        lambda trace: replace(trace, info=replace(trace.info, reason="lost")),
        lambda trace: replace(trace, events=()),
        lambda trace: replace(trace, columns=trace.columns | {"tau": trace["tau_cmd"]}),
        lambda trace: replace(
            trace, columns={name: values[:-1] for name, values in trace.columns.items()}
        ),
    ],
    ids=["counted as ok", "another reason", "no event", "the controller acts on", "ends early"],
)
def test_a_stop_that_is_none_is_caught(stopped: Trace, broken: Any) -> None:
    with pytest.raises(AssertionError):
        check_stop(broken(stopped))


def test_a_sensor_that_is_off_does_not_disarm_it(stopped: Trace) -> None:
    off = pd("safety.q_max=0.6", "imperfections.position_bias=-0.5")
    check_stop(off)
    assert off["q_meas"].max() < 0.6
    assert off.info.status == "diverged"


@QUIET
def test_the_stop_has_no_more_torque_than_the_drives() -> None:
    weak = ("imperfections.torque_limit=[20, 5]", "imperfections.torque_rate=3000")
    trace = pd("safety.qd_max=0.3", *weak)
    check_stop(trace)
    assert np.abs(trace["tau"]).max(axis=0) == pytest.approx([20.0, 5.0])


def test_a_scenario_without_room_between_its_limits_is_refused() -> None:
    with pytest.raises(ScenarioError, match=r"safety.*q_max.*is not above q_min; allowed: more"):
        load_scenario("paper", ["safety={q_min: [0.0, 1.0], q_max: 0.5}"])
    with pytest.raises(ScenarioError, match=r"safety\.qd_max.*3 entries"):
        load_scenario("paper", ["safety.qd_max=[1.0, 2.0, 3.0]"])


@QUIET
def test_events_tell_the_limit_of_a_torque_from_that_of_its_rate() -> None:
    words = [event.message for event in pd("imperfections.torque_rate=2000").events]
    assert words[0] == "torque rate limit reached"
    assert "torque limit reached" not in words
    words = [event.message for event in pd("imperfections.torque_limit=30").events]
    assert words[0] == "torque limit reached"
    assert "torque rate limit reached" not in words
