"""Ctrl-C once: it is not lost on its way, and what has begun to end is not broken off by another.

A KeyboardInterrupt is raised wherever the interpreter happens to be. Some libraries let it vanish
there: with a bare `except` while they are imported, or since it cannot pass through a callback from
C. So a press is remembered until it has been heard, and `raise_lost` raises it again.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_pressed = threading.Event()  # and not heard yet


def remember_presses() -> None:
    """From now on Ctrl-C can be raised again; whoever handles SIGINT otherwise is left alone."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
        sys.unraisablehook = _tell_others


def raise_lost() -> None:
    """To be called now and then, where work goes on that a Ctrl-C must end.

    Raises:
        KeyboardInterrupt: one was pressed, and something has swallowed it.
    """
    if _pressed.is_set():
        raise KeyboardInterrupt


def heard() -> None:
    """The Ctrl-C has come where it is dealt with."""
    _pressed.clear()


@contextmanager
def interrupted_once() -> Iterator[Callable[[], None]]:
    """Inside, the first Ctrl-C raises KeyboardInterrupt, and no other one does anything.

    Yields:
        A function to call where even the first one would come too late. Whoever handles SIGINT
        otherwise, or runs in another thread than the first, is left alone.
    """
    before = signal.getsignal(signal.SIGINT)
    ending = threading.Event()
    in_charge = threading.current_thread() is threading.main_thread()
    if before not in (signal.default_int_handler, _interrupt) or not in_charge:
        yield ending.set
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        if not (ending.is_set() or _pressed.is_set()):
            _interrupt(number, frame)

    def end() -> None:
        ending.set()
        heard()

    signal.signal(signal.SIGINT, interrupt)
    try:
        yield end
    finally:
        signal.signal(signal.SIGINT, before)
        heard()


@contextmanager
def held_back() -> Iterator[None]:
    """Inside, Ctrl-C and SIGTERM wait for the end: for a library that they would break half-way.

    A signal that Python does not handle does what it always does, and so does every one in another
    thread than the first.
    """
    came: list[tuple[int, FrameType | None]] = []
    handlers = {}
    if threading.current_thread() is threading.main_thread():
        found = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
        handlers = {number: handler for number, handler in found.items() if callable(handler)}

    def wait(number: int, frame: FrameType | None) -> None:
        came.append((number, frame))

    try:
        for kind in handlers:
            signal.signal(kind, wait)
        yield
    finally:
        for kind, handler in handlers.items():
            signal.signal(kind, handler)
        if came:
            number, frame = came[0]
            handlers[signal.Signals(number)](number, frame)


def _tell_others(what: sys.UnraisableHookArgs) -> None:
    """What could not be raised is told, but for Ctrl-C, which is raised again."""
    if not issubclass(what.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(what)


def _interrupt(_number: int, _frame: FrameType | None) -> None:
    _pressed.set()
    raise KeyboardInterrupt
