"""Compute a stretch of a log again, and hold it against what the log says."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dnnmso_mj.branching import code_of, misfit
from dnnmso_mj.difference import CLOCKED, rows_differ
from dnnmso_mj.errors import LogError
from dnnmso_mj.loading.trust import named_code
from dnnmso_mj.log.segments import Segment
from dnnmso_mj.memory_recorder import LARGEST_BLOCK
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.provenance import git_commit, software_versions
from dnnmso_mj.recorded import Recorded
from dnnmso_mj.simulation import Simulation
from dnnmso_mj.trace import Event, StepLayout
from dnnmso_mj.world_state import EXTERNAL, State

Array = np.ndarray

SNAPSHOTS = ("controller", "world")
TRIED = 100  # ticks that a state is tried for


class Found(NamedTuple):
    """What computing again has found.

    Args:
        state: before the tick; None before tick 0.
        checked: how many ticks were computed again.
        events: that happened in them.
    """

    state: State | None
    checked: int
    events: list[Event]


def state_at(source: Recorded, segment: Segment, mjcf: Mjcf, tick: int) -> Found:
    """The state that a log's run was in before a tick.

    Args:
        source: the log.
        segment: of it, to which the tick belongs.
        mjcf: the segment's model.
        tick: at most the number of ticks in the log.

    Raises:
        LogError: one of them is not what the log says, or the run ended there.
    """
    if tick == 0:
        return Found(None, 0, [])
    simulation = Simulation(segment.scenario, mjcf)
    if simulation.layout.n_layers > source.layout.n_layers:
        raise LogError(
            f"{source.path}: has {source.layout.n_layers} layers of a network; its scenario "
            f"{simulation.layout.n_layers}. {_versions(source)}"
        )
    start = _nearest(source, segment, tick)
    state = _snapshot(source, simulation, start) if start else None
    if state is not None and start == tick:
        _try(source, segment, mjcf, state)
        return Found(state, 0, [])
    _refuse_missed(source, start, tick)
    check = _Check(source, simulation.layout, start)
    info = simulation.run(check, start=state, until=tick)
    if info.status == "diverged":
        last = (tick - 1) * segment.scenario.dt
        raise LogError(f"{source.path}: {info.reason}; allowed: --at {last:g} or before")
    state = simulation.state()
    _try(source, segment, mjcf, state)
    return Found(state, tick - start, check.events)


def _try(source: Recorded, segment: Segment, mjcf: Mjcf, state: State) -> None:
    """Go on from a state as the log does, for a while, in a simulation that was never before it.

    So what code from outside remembers beside its state is missed before anything is written.
    """
    later = (part.first for part in source.segments if part.first > state.tick)
    end = min([state.tick + TRIED, len(source.trace), *later])
    missed = np.flatnonzero(source.trace["deadline_missed"][state.tick : end])
    end = state.tick + int(missed[0]) if missed.size else end
    if end > state.tick:
        simulation = Simulation(segment.scenario, mjcf)
        check = _Check(source, simulation.layout, state.tick)
        simulation.run(check, start=state, until=end)


def _nearest(source: Recorded, segment: Segment, tick: int) -> int:
    """The tick of the last whole snapshot before; so that something can be checked."""
    whole = [k for k, name in source.snapshots if name == "world" and _is_whole(source, k)]
    starts = [k for k in whole if segment.first <= k < tick]
    if segment.first == 0:
        starts.append(0)
    if segment.first == tick and tick in whole:
        starts.append(tick)
    if not starts:
        t = segment.first * segment.scenario.dt
        raise LogError(
            f"{source.path}: no snapshot since the branch at {t:g} s; allowed: before it"
        )
    return max(starts)


def _is_whole(source: Recorded, tick: int) -> bool:
    return all((tick, name) in source.snapshots for name in SNAPSHOTS)


def _snapshot(source: Recorded, simulation: Simulation, tick: int) -> State:
    """A snapshot as a state that this simulation can begin in."""
    controller, world = (source.arrays(tick, name) for name in SNAPSHOTS)
    simulation.begin()
    fresh = simulation.state()
    # Code from outside may keep other things at other times, and says itself what is wrong.
    ours = [
        {n: v for n, v in w.items() if not n.startswith(EXTERNAL)} for w in (world, fresh.world)
    ]
    own = not code_of(simulation.scenario)
    wrong = (own and misfit(controller, fresh.controller)) or misfit(*ours)
    if wrong:
        t = tick * simulation.scenario.dt
        raise LogError(
            f"{source.path}: the snapshot of {t:g} s is not one of this version: {wrong}. "
            f"{_versions(source)}"
        )
    return State(tick, controller, world)


def _refuse_missed(source: Recorded, start: int, tick: int) -> None:
    """What the wall clock has done cannot be done again."""
    missed = np.flatnonzero(source.trace["deadline_missed"][start:tick])
    if missed.size:
        first, second = (k * source.trace.scenario.dt for k in (start + missed[0], start))
        raise LogError(
            f"{source.path}: a deadline was missed at {first:g} s, which cannot be computed "
            f"again; allowed: --at from {second:g} to {first:g}, or in a second without a miss"
        )


class _Check:
    """Takes ticks that are computed again; the first that differs from the log ends it."""

    block = LARGEST_BLOCK
    keeps_snapshots = False

    def __init__(self, source: Recorded, layout: StepLayout, start: int) -> None:
        self.events: list[Event] = []
        self._source, self._layout, self._done = source, layout, start

    def append(self, rows: Array) -> None:
        source = self._source
        theirs = {name: v[self._done :][: len(rows)] for name, v in source.trace.columns.items()}
        ours = source.layout.columns(source.layout.rows(self._layout.columns(rows)))
        differing = {
            name: int(np.flatnonzero(rows_differ(ours[name], theirs[name]))[0])
            for name in ours
            if name not in CLOCKED and rows_differ(ours[name], theirs[name]).any()
        }
        if differing:
            name = min(differing, key=lambda name: differing[name])
            k = differing[name]
            raise LogError(
                f"{source.path}: tick {self._done + k} (t = {theirs['t'][k]:g} s) is not computed "
                f"again as it was: {name} = {ours[name][k].tolist()}, and in the log "
                f"{theirs[name][k].tolist()}. {_versions(source)}"
            )
        self._done += len(rows)

    def event(self, event: Event) -> None:
        self.events.append(event)

    def snapshot(self, name: str, t: float, arrays: Mapping[str, Array]) -> None:
        """None is kept."""


def _versions(source: Recorded) -> str:
    """What made the log and is different here."""
    info = source.trace.info
    here = software_versions() | {"commit": git_commit()}
    there = {**info.versions, "commit": info.git_commit}
    differing = [
        f"{name} {there[name]} (here {here[name]})"
        for name in here
        if name in there and there[name] != here[name]
    ]
    if differing:
        return f"It was made with {', '.join(differing)}."
    said = "It was made with the same versions, so on another kind of processor"
    scenarios = [part.scenario for part in source.segments]
    if any(code_of(each) or any(named_code(each.model_dump())) for each in scenarios):
        return f"{said}, or its code has changed, or remembers more than its state() gives."
    return f"{said}."
