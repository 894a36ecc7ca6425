"""What happens in a run, as coloured bands over its time: limits, deadlines, and the events."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import rerun as rr

from dnnmso_mj.scenario import Freeze, Payload, Push, Scenario
from dnnmso_mj.trace import Array, Trace
from dnnmso_mj.viewer.look import Look
from dnnmso_mj.viewer.plot import RED, Rgb, darker
from dnnmso_mj.viewer.stamps import stamps

GONE = ""  # the viewer's word for a gap
GOOD: Rgb = (46, 110, 70)
BAD: Rgb = (200, 60, 60)
_YELLOW, _BLUE, _VIOLET, _TEAL = (220, 180, 0), (50, 105, 180), (120, 85, 180), (30, 135, 135)
ENDS = {"diverged": BAD, "failed": BAD, "interrupted": (110, 110, 110), "unfinished": BAD}
_TAIL = 0.03  # of the run: how long its end is shown where that was not as planned


@dataclass(frozen=True)
class Lane:
    """One band: at each tick one of its states, whose word and colour it shows.

    Args:
        name: what stands over it, and its place among all lanes.
        words: of the states; an empty one leaves a gap.
        colors: of the states.
        states: a stretch of N ticks and their numbers (N,) -> the number of each tick's state (N,).
    """

    name: str
    words: tuple[str, ...]
    colors: tuple[Rgb, ...]
    states: Callable[[Trace, Array], Array]


class Lanes:
    """A run's bands on their way into Rerun, a stretch of ticks at a time.

    Args:
        recording: where to.
        scenario: the experiment.
        root: what the paths of all entities begin with.
        look: the colour of the run.
    """

    def __init__(
        self, recording: rr.RecordingStream, scenario: Scenario, root: str, look: Look
    ) -> None:
        self._recording = recording
        self._dt = scenario.dt
        # Beside others the end of a short run must be seen on their axis of time.
        self._planned = scenario.n_ticks if look.name else 0
        self._root = root
        self._lanes = lanes(scenario, darker(look.color) if look.color else GOOD)
        self.names = [lane.name for lane in self._lanes]
        self._last: dict[str, str | None] = dict.fromkeys(self.names)
        self._tick = 0
        self._in_force = (scenario, self._lanes)

    def begin(self) -> None:
        """The colour of each state."""
        for lane in self._lanes:
            pairs = zip(lane.words, lane.colors, strict=True)
            colors = {word: color for word, color in pairs if word != GONE}
            if lane is self._lanes[0]:
                colors |= ENDS
            style = rr.StateConfiguration(values=list(colors), colors=list(colors.values()))
            self._recording.log(self._root + lane.name, style, static=True)

    def send(self, trace: Trace, ticks: Array) -> None:
        """The changes in a stretch of ticks (N,), under the scenario that was in force in it."""
        scenario = trace.scenario
        if scenario is not self._in_force[0]:
            self._in_force = (scenario, lanes(scenario))
        in_force = {lane.name: lane for lane in self._in_force[1]}
        for lane in self._lanes:
            then = in_force.get(lane.name)
            words = np.array(then.words if then else [GONE], dtype=object)
            said = words[then.states(trace, ticks) if then else np.zeros(len(ticks), int)]
            before = np.concatenate([[self._last[lane.name]], said[:-1]])
            changes = np.flatnonzero(said != before)
            self._last[lane.name] = said[-1]
            self._send(lane, ticks[changes], said[changes].tolist())
        self._tick = int(ticks[-1])

    def end(self, status: str) -> None:
        """The end of the run, which is a state of its first lane where it was not as planned."""
        gone, words = [self._tick + 1], [GONE]
        if status in ENDS:
            tail = max(1, round(_TAIL * max(self._tick, self._planned)))
            gone, words = [self._tick, self._tick + tail], [status, GONE]
        self._send(self._lanes[0], np.array(gone), words)

    def _send(self, lane: Lane, ticks: Array, words: list[str]) -> None:
        if len(ticks):
            columns = rr.StateChange.columns(state=words)
            self._recording.send_columns(
                self._root + lane.name, stamps(ticks * self._dt, ticks), columns
            )


def lanes(scenario: Scenario, running: Rgb = GOOD) -> list[Lane]:
    """The bands of a scenario: how the run goes, and one for each kind of event that it has."""
    words, colors = ("running", "torque limit", "deadline missed"), (running, _YELLOW, RED)
    made = [Lane("run", words, colors, _run)]
    kinds = {type(event) for event in scenario.events}
    if Freeze in kinds:
        made.append(_freezes(scenario))
    if Payload in kinds:
        made.append(_payloads(scenario))
    if Push in kinds:
        made.append(_pushes(scenario))
    return made


def _run(trace: Trace, ticks: Array) -> Array:
    return np.where(trace["deadline_missed"], 2, trace["saturated"].astype(int))


def _freezes(scenario: Scenario) -> Lane:
    freezes = sorted((e for e in scenario.events if isinstance(e, Freeze)), key=lambda e: e.at)
    words = {"model": "learning has ended", "all": "learning and disturbance estimate have ended"}
    at = _ticks([event.at for event in freezes], scenario)
    return Lane(
        "learning",
        (GONE, *(words[event.what] for event in freezes)),
        (GOOD, *[_BLUE] * len(freezes)),
        lambda trace, ticks: np.searchsorted(at, ticks, side="right"),
    )


def _payloads(scenario: Scenario) -> Lane:
    payloads = sorted((e for e in scenario.events if isinstance(e, Payload)), key=lambda e: e.at)
    carried = np.cumsum([event.mass for event in payloads])
    at = _ticks([event.at for event in payloads], scenario)
    return Lane(
        "payload",
        (GONE, *(f"{mass:+.4g} kg" if abs(mass) > 1e-12 else GONE for mass in carried)),
        (GOOD, *[_VIOLET] * len(payloads)),
        lambda trace, ticks: np.searchsorted(at, ticks, side="right"),
    )


def _pushes(scenario: Scenario) -> Lane:
    pushes = [event for event in scenario.events if isinstance(event, Push)]
    begins = np.sort(_ticks([event.at for event in pushes], scenario))
    lasts = _ticks([event.duration for event in pushes], scenario)
    ends = np.sort(_ticks([event.at for event in pushes], scenario) + lasts)

    def states(trace: Trace, ticks: Array) -> Array:
        begun = np.searchsorted(begins, ticks, side="right")
        acting: Array = begun > np.searchsorted(ends, ticks, side="right")
        return acting.astype(int)

    return Lane("push", (GONE, "push"), (GOOD, _TEAL), states)


def _ticks(times: list[float], scenario: Scenario) -> Array:
    return np.array([round(t / scenario.dt) for t in times])
