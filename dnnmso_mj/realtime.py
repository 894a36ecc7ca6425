"""Ticks paced by the wall clock: deadlines, the watchdog, and a process that is left in peace.

Tick k is due at start + k·dt, absolutely, so that nothing drifts; its command must come before the
next tick is due. Where it does not, because the process woke late or the controller took too long,
the watchdog's torque acts in that period instead, and ticks whose whole period has passed get no
control at all: a robot would not have waited either. The arm, being simulated, takes every step.
"""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from dnnmso_mj.scenario import Scenario
from dnnmso_mj.tick import DAMPED, HOLD, ZERO, Pace

WATCHDOGS = {"hold": HOLD, "zero": ZERO, "damped": DAMPED}

_PRIORITY = 50  # of SCHED_FIFO, above ordinary processes and below the kernel's own threads
_NICE = -10
_SWITCH_INTERVAL = 1e-4  # s; how long another Python thread may keep the loop waiting at most
_SET_TIMER_SLACK = 29  # PR_SET_TIMERSLACK of Linux's <sys/prctl.h>


def real_time_pace(scenario: Scenario) -> Pace:
    """Pace of one simulated second a second, with the scenario's watchdog and stalls."""
    spec, dt = scenario.real_time, scenario.dt
    stalls = sorted((round(stall.at / dt), round(stall.duration * 1e9)) for stall in spec.stalls)
    return Pace(
        period_ns=round(dt * 1e9),
        watchdog=WATCHDOGS[spec.watchdog],
        damping=spec.damping,
        stalls=np.array(stalls, np.int64).reshape(-1, 2),
    )


@contextmanager
def left_in_peace() -> Iterator[str]:
    """Keep this thread from being held up, as far as the system allows; undone at the end.

    No garbage collection, short turns for other Python threads, exact timers, one thread for
    torch, and a real-time priority or, without the right to one, a better nice value.

    Yields:
        In words, the priority that was granted.
    """
    interval, collecting = sys.getswitchinterval(), gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    sys.setswitchinterval(_SWITCH_INTERVAL)
    libc = ctypes.CDLL(None)
    libc.prctl(_SET_TIMER_SLACK, ctypes.c_ulong(1), 0, 0, 0)
    torch = sys.modules.get("torch")
    threads = torch.get_num_threads() if torch else 1
    if torch:
        torch.set_num_threads(1)
    priority, restore = _raise_priority()
    try:
        yield priority
    finally:
        restore()
        if torch:
            torch.set_num_threads(threads)
        libc.prctl(_SET_TIMER_SLACK, ctypes.c_ulong(0), 0, 0, 0)  # 0: the thread's default
        sys.setswitchinterval(interval)
        gc.unfreeze()
        if collecting:
            gc.enable()


def _raise_priority() -> tuple[str, Callable[[], object]]:
    """The best priority for this thread alone that the system grants, and how to undo it."""
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except OSError:
        pass
    else:
        return f"SCHED_FIFO {_PRIORITY}", lambda: os.sched_setscheduler(0, policy, parameters)
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    try:
        os.setpriority(os.PRIO_PROCESS, 0, _NICE)
    except OSError:
        return f"nice {nice}; no right to a better one", lambda: None
    return f"nice {_NICE}", lambda: os.setpriority(os.PRIO_PROCESS, 0, nice)
