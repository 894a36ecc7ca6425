"""Ctrl-C once: what has begun to end is not broken off by a second one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


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
    if before is not signal.default_int_handler or not in_charge:
        yield ending.set
        return

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        if not ending.is_set():
            ending.set()
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, interrupt)
    try:
        yield ending.set
    finally:
        signal.signal(signal.SIGINT, before)
