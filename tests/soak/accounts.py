"""Whether a paced log tells the truth of its deadlines: what it says against accounts of others.

Each function gives what does not agree, in words; nothing where all does. Times are in ns, and tick
k is due at start + k·period.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from dnnmso_mj.trace import Array, Trace

ACTS, IN_TIME = "deadline missed: the watchdog acts", "in time again"
US = 1000.0  # ns
ROUNDING_NS = 2.0  # of µs in doubles
WITHIN_TICKS = 2  # a watchdog has to act


def few(what: str, ticks: Array) -> list[str]:
    """One line about some ticks, or none."""
    if not len(ticks):
        return []
    shown = ", ".join(str(int(k)) for k in ticks[:8]) + (" …" if len(ticks) > 8 else "")
    return [f"{len(ticks)} ticks {what}: {shown}"]


def lost_ticks(trace: Trace, n_ticks: int, dt: float) -> list[str]:
    """Ticks that the log does not hold, each once and in their order."""
    if len(trace) != n_ticks:
        return [f"{len(trace)} ticks in the log instead of {n_ticks}"]
    return few("not at their time", np.flatnonzero(trace["t"] != np.arange(n_ticks) * dt))


def against_itself(trace: Trace, period: int) -> list[str]:
    """Flags, wake-ups, computing times and events must add up, since a clock only goes forward."""
    missed = trace["deadline_missed"].astype(bool)
    late, took = trace["wake_late_us"] * US, trace["compute_us"] * US
    ready = late + took  # the command cannot have been there before
    slack = period + ROUNDING_NS
    out = few("are late and not flagged", np.flatnonzero(~missed & (ready > slack)))
    asleep = late >= period
    out += few("woke after their period and are not flagged", np.flatnonzero(asleep & ~missed))
    out += few("woke after their period and had control", np.flatnonzero(asleep & (took > 0)))
    out += few("woke in time and had none", np.flatnonzero(~asleep & (took == 0)))
    out += few(
        "begin before the last one's command was there",
        1 + np.flatnonzero(late[1:] < ready[:-1] - period - ROUNDING_NS),
    )
    # A tick that is flagged ended after the next was due, which then did not wait.
    out += few(
        "are due after a miss, yet on time", 1 + np.flatnonzero(missed[:-1] & (late[1:] <= 0))
    )
    return out + against_events(trace, missed)


def against_events(trace: Trace, missed: Array) -> list[str]:
    """Every beginning and end of a row of misses is an event, and nothing else is."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], missed.astype(int)])))
    expected = [(round(trace["t"][k] * 1e6), ACTS if missed[k] else IN_TIME) for k in edges]
    told = [(round(e.t * 1e6), e.message) for e in trace.events if e.message in (ACTS, IN_TIME)]
    return [] if told == expected else [f"{len(told)} events of {len(expected)} misses' edges"]


def against_stamps(trace: Trace, stamps: Array, start: int, period: int) -> tuple[list[str], int]:
    """Against stamps (ticks, 4) of who called each tick; and for how many they leave it open.

    A command counts as late from when it is looked at, between the last two stamps.
    """
    missed = trace["deadline_missed"].astype(bool)
    due = start + period * np.arange(len(stamps))
    end = due + period
    had_control = trace["compute_us"] > 0
    out = few("were begun early", np.flatnonzero(stamps[:, 1] < due))
    unfair = ~had_control & (stamps[:, 1] < end)
    out += few("got no control though there was time", np.flatnonzero(unfair))
    surely, surely_not = stamps[:, 2] > end, stamps[:, 3] <= end
    out += few("came late and are not flagged", np.flatnonzero(surely & ~missed))
    out += few("were in time and are flagged", np.flatnonzero(surely_not & missed))
    return out, int(np.count_nonzero(~surely & ~surely_not))


def within(windows: Iterable[tuple[int, int]], start: int, period: int, n_ticks: int) -> Array:
    """Ticks whose whole period lies in one of the windows (from, to)."""
    due = start + period * np.arange(n_ticks)
    inside = np.zeros(n_ticks, bool)
    for begin, end in windows:
        inside |= (due >= begin) & (due + period <= end)
    return inside


def against_windows(
    trace: Trace, windows: Iterable[tuple[int, int]], start: int, period: int
) -> list[str]:
    """In a time in which the process was surely not run, every tick is missed."""
    inside = within(windows, start, period, len(trace))
    missed = trace["deadline_missed"].astype(bool)
    return few("passed while the process stood still, unflagged", np.flatnonzero(inside & ~missed))


def against_watchdog(trace: Trace, watchdog: str, damping: float) -> tuple[list[str], int]:
    """A watchdog's torque acts at most two ticks after a miss; and what it took at most."""
    missed = trace["deadline_missed"].astype(bool)
    tau, hold = trace["tau"], np.vstack([np.zeros(trace["tau"].shape[1]), trace["tau"][:-1]])
    wanted = {"hold": hold, "zero": 0.0 * tau, "damped": -damping * trace["qd_meas"]}[watchdog]
    acts = (tau == wanted).all(axis=1)
    worst = 0
    edges = np.flatnonzero(np.diff(np.concatenate([[0], missed.astype(int), [0]])))
    for first, after in zip(edges[::2], edges[1::2], strict=True):
        right = np.flatnonzero(acts[first:after])
        worst = max(worst, int(right[0]) if len(right) else int(after - first))
    stray = few("have not the watchdog's torque", np.flatnonzero(missed & ~acts))
    given = trace["tau_cmd"]
    stray += few("have another torque than the command", np.flatnonzero(
        ~missed & (tau != given).any(axis=1)))  # fmt: skip
    if worst >= WITHIN_TICKS:
        stray.append(f"the watchdog took {worst} ticks to act")
    return stray, worst
