"""What must hold of a run that something not finite was put into."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from dnnmso_mj.difference import CLOCKED
from dnnmso_mj.reading import log_info, read_snapshots, read_trace
from dnnmso_mj.trace import Trace
from soak.faults import LEARNED, OPTIMISER, Fault, Struck

LAST = 100  # states before the fault that the log must hold
TORQUES = ("tau", "tau_cmd")
STATES = ("q", "qd", "|q|", "|qd|", "|qdd|")
# What a message may name first: what was put there, or what the next tick made of it.
NAMES: Mapping[str, tuple[str, ...]] = {
    "sensor": ("q_meas", "qd_meas", "|q_meas|", "|qd_meas|", "|x_hat|"),
    "torque": ("tau",),
    "force": ("torque beside the motors'", *STATES),
    "state": STATES,
}


def check(struck: Struck, clean: Trace) -> None:
    """Assert all of it.

    Args:
        struck: the run.
        clean: the same without the fault.
    """
    fault, trace = struck.fault, logged(struck)
    assert fault is not None
    check_rows(trace, clean, fault.tick)
    check_end(trace)
    assert struck.seen.passes > 0 or len(trace) == 0, "nobody looked"
    assert not struck.seen.bad, f"MuJoCo was given {struck.seen.bad[0]}"
    assert not struck.warnings, f"MuJoCo warned {struck.warnings} times"
    check_time(struck, trace, clean)
    if trace.info.status == "ok" and (
        may_live(fault) or (fault.where in {"observer", "optimiser"} and same_run(trace, clean))
    ):
        assert len(trace) == trace.scenario.n_ticks
        return
    assert trace.info.status == "diverged", f"status {trace.info.status}"
    check_reason(struck, fault, trace)
    check_weights(struck, trace)


def logged(struck: Struck) -> Trace:
    """What the log says, and nothing but the log."""
    info = log_info(struck.run.log)
    assert info.complete, "the log is torn"
    if info.ticks:
        return read_trace(struck.run.log)
    told = replace(struck.run.trace.info, status=info.status, reason=info.reason)
    return replace(struck.run.trace, info=told, events=info.events)


def may_live(fault: Fault) -> bool:
    """Whether a run may end well with it: a huge value, still a number, that does no harm."""
    told = fault.where in {"sensor", "weights", "optimiser", "observer", "gradient"}
    return told and math.isfinite(fault.value)


def same_run(trace: Trace, clean: Trace) -> bool:
    """Whether a value went to a place that nothing reads before it is written anew."""
    names = set(trace) - set(CLOCKED)
    return all(np.array_equal(trace[name], clean[name]) for name in names)


def check_rows(trace: Trace, clean: Trace, tick: int) -> None:
    """Every tick before the fault is there, as it was without; and what is there is finite."""
    assert len(trace) >= tick, f"{len(trace)} ticks; the fault came before tick {tick}"
    assert np.array_equal(trace["t"], np.arange(len(trace)) * trace.scenario.dt), "a hole in time"
    for name in set(trace) - set(CLOCKED):
        same = np.array_equal(trace[name][:tick], clean[name][:tick])
        assert same, f"{name} differs before the fault"
        assert np.isfinite(trace[name]).all(), f"{name} is not finite in the log"


def check_end(trace: Trace) -> None:
    """The last states are those of an arm that moves as its velocity says, not held ones."""
    q, qd = trace["q"][-LAST:], trace["qd"][-LAST:]
    held = (np.diff(q, axis=0) == 0.0) & (np.abs(qd[1:]) > 1e-6) & (np.abs(qd[:-1]) > 1e-6)
    assert not held.any(), f"a frozen tail from tick {len(trace) - len(q) + held.argmax() // 2}"


def check_time(struck: Struck, trace: Trace, clean: Trace) -> None:
    """MuJoCo's clock never went back, nor the arm to where it started."""
    dt = trace.scenario.dt
    expected = np.arange(1, len(struck.times) + 1) * dt
    off = np.abs(np.array(struck.times) - expected)
    # The last tick's row is kept, where it ends the run, without a step.
    assert (off <= 1.5 * dt).all(), "time has jumped"
    start = np.array(trace.scenario.initial.q)
    back, there = ((one["q"][: len(trace)] == start).all(axis=1) for one in (trace, clean))
    assert not (back & ~there).any(), f"back at the start in tick {(back & ~there).argmax()}"


def check_reason(struck: Struck, fault: Fault, trace: Trace) -> None:
    """It names a quantity that was wrong, and when; and the log's event says the same."""
    reason, dt = trace.info.reason, trace.scenario.dt
    found = re.fullmatch(r"(.+?) = (.+) at t = (\S+) s", reason)
    assert found, f"reason: {reason}"
    ended = round(float(found[3]) / dt)
    # A weight shows in the tick after; an infinite moment stops learning, and is found in a second.
    delays = {"weights": 1, "gradient": 1, "torque": 4}
    late = delays.get(fault.where, 0)
    if trace.scenario.controller.kind == "dnn_mso_replay" and fault.where in {
        "weights",
        "gradient",
    }:
        late += 1  # it drives by a mean of the weights that were before
    if fault.where in {"optimiser", "observer"} or may_live(fault):
        late = trace.scenario.n_ticks - fault.tick
    if not math.isfinite(fault.value):
        assert fault.tick <= ended <= fault.tick + late, f"{reason}; the fault is of {fault.tick}"
    names = NAMES.get(fault.where)
    if names is not None:
        assert found[1] in names, f"{reason}; allowed: {names}"
    elif not math.isfinite(fault.value):
        told = re.findall(r"\w+", reason)
        wanted = {*LEARNED, *OPTIMISER}
        if fault.where == "observer":
            wanted = {*struck.kept, *trace}
        assert set(told) & wanted, f"{reason}; allowed: one of {sorted(wanted)}"
    last = trace.events[-1]
    assert (last.level, last.message) == ("error", f"diverged: {reason}")
    assert abs(last.t - ended * dt) < 0.5 * dt


def check_weights(struck: Struck, trace: Trace) -> None:
    """The log's last snapshot is what the controller kept when the run ended, to the last bit."""
    snapshots = [s for s in read_snapshots(struck.run.log) if s.name == "controller"]
    last = snapshots[-1]
    assert abs(last.t - trace.events[-1].t) < 0.5 * trace.scenario.dt, "no snapshot at the end"
    assert set(last.arrays) == set(struck.kept), "a snapshot that lacks something"
    for name, values in struck.kept.items():
        numbers = values.dtype.kind not in "SU"
        assert np.array_equal(last.arrays[name], values, equal_nan=numbers), f"{name} in the log"
