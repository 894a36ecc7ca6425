"""Work done beside the loop, in order, by a thread of its own."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable

Job = Callable[[], None]


class Background:
    """Does jobs in the order they were given, in a daemon thread.

    Giving one takes a microsecond and never waits, unless jobs of more than `limit` bytes wait to
    be done: then the caller does too, until no more than that are, and `waited_s` says for how
    long.

    After a job's exception the rest are dropped; `put` and `drain` raise it.

    Args:
        limit: bytes.
    """

    def __init__(self, limit: int) -> None:
        self.waited_s = 0.0
        self._limit = limit
        self._jobs: queue.SimpleQueue[tuple[Job, int] | threading.Event | None]
        self._jobs = queue.SimpleQueue()
        self._put_off: list[tuple[Job, int]] = []
        self._given = self._done = 0  # bytes; the caller writes one, the thread the other
        self._room = threading.Event()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._work, name="dnnmso-log", daemon=True)
        self._thread.start()

    def put(self, job: Job, size: int = 0) -> None:
        """Have a job done that holds `size` bytes until then, after those put off."""
        self.put_off(job, size)
        while self._put_off:
            given = self._put_off.pop(0)  # first: a Ctrl-C in between must not have it done twice
            self._jobs.put(given)
            self._given += given[1]
        if self._given - self._done > self._limit:
            self._wait_for_room()

    def put_off(self, job: Job, size: int = 0) -> None:
        """Have a job done before the next one that is `put`, which alone wakes the thread.

        A thread that wakes asks for the interpreter, which the caller may still need.
        """
        if self._error is not None:
            raise self._error
        self._put_off.append((job, size))

    def drain(self) -> None:
        """Wait until every job so far is done."""
        reached = threading.Event()
        self._jobs.put(reached)
        reached.wait()
        if self._error is not None:
            raise self._error

    def _wait_for_room(self) -> None:
        started = time.perf_counter()
        while self._given - self._done > self._limit:
            self._room.clear()
            if self._given - self._done > self._limit:  # what came before `clear` is not missed
                self._room.wait()
        self.waited_s += time.perf_counter() - started
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        """Let the thread end after the jobs so far."""
        self._jobs.put(None)
        self._thread.join()

    def _work(self) -> None:
        while (given := self._jobs.get()) is not None:
            if isinstance(given, threading.Event):
                given.set()
                continue
            job, size = given
            if self._error is None:
                try:
                    job()
                except Exception as error:  # whatever it is, the caller is to be told
                    self._error = error
            self._done += size
            self._room.set()
            del given, job  # frees the block before the next one comes
