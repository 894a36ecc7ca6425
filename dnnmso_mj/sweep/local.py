"""A sweep on this machine: one process a core, each behind a pipe of its own.

Every worker is a fresh interpreter. Since each has its own pipe, a process that dies (a segfault,
an out-of-memory kill) points at the very run it was in, and no other worker notices.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import wait
from typing import Self

from dnnmso_mj.sources import python_path
from dnnmso_mj.sweep.plan import SweepError
from dnnmso_mj.sweep.task import Row, Work, failed_row

# The cores are shared out by the sweep; a library's own threads would only fight for them.
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)


class LocalEngine:
    """Runs tasks on the cores of this machine.

    Args:
        jobs: worker processes; None takes every core that this process may use.
    """

    name = "local"

    def __init__(self, jobs: int | None = None) -> None:
        self.jobs = jobs or len(os.sched_getaffinity(0))

    def rows(self, tasks: Iterable[Work]) -> Generator[Row]:
        """Yield every run's row as it is finished; closing the generator ends the workers.

        A run whose process dies is tried once more, after all others; if that dies too, its row
        says how.

        Raises:
            SweepError: workers cannot be started.
        """
        with WorkerPool(self.jobs) as pool:
            yield from pool.rows(tasks)


class WorkerPool:
    """Worker processes that stay for more tasks; a context manager that ends them.

    Args:
        jobs: how many at most; they are started when there is something to do.
    """

    def __init__(self, jobs: int) -> None:
        self.jobs = jobs
        self._workers: list[_Worker] = []
        self._begin(())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.kill()

    def rows(self, tasks: Iterable[Work]) -> Generator[Row]:
        """Yield every run's row as it is finished; see `LocalEngine.rows`.

        Closing the generator before its end ends the workers; the next call starts others.
        """
        self._begin(tasks)
        finished = False
        try:
            for worker in self._workers:
                self._feed(worker)
            while len(self._workers) < self.jobs and self._start():
                pass
            while busy := [worker.pipe for worker in self._workers if worker.busy]:
                speaking = wait(busy)
                for worker in [worker for worker in self._workers if worker.pipe in speaking]:
                    yield from self._listen(worker)
            finished = True
        finally:
            if not finished:
                self.kill()

    def kill(self) -> None:
        """End the workers, whatever they do."""
        for worker in self._workers:
            worker.kill()
        self._workers.clear()

    def _begin(self, tasks: Iterable[Work]) -> None:
        self._tasks = iter(tasks)
        self._rest: deque[Work] = deque()  # of tasks whose process died
        self._again: deque[Work] = deque()  # runs that were under way when it did
        self._suspects: set[tuple[int, int]] = set()
        self._stillborn = 0

    def _listen(self, worker: _Worker) -> Iterator[Row]:
        """Take one message, or the end, of a worker; give it more to do when it is done."""
        try:
            message = worker.pipe.recv()
        except (EOFError, OSError):
            self._workers.remove(worker)
            yield from self._bury(worker)
            self._start()
            return
        if worker.seeds:
            worker.seeds.popleft()
            yield message
        worker.ready = True
        if not worker.seeds:
            self._feed(worker)

    def _start(self) -> bool:
        """One more worker, if there is a task for it."""
        task = self._next()
        if task is None:
            return False
        try:
            self._workers.append(_Worker(task))
        except OSError as error:
            raise SweepError(
                f"--jobs: worker process {len(self._workers) + 1} cannot be started: "
                f"{error.strerror or error}; allowed: fewer --jobs"
            ) from error
        return True

    def _feed(self, worker: _Worker) -> None:
        task, worker.first = worker.first or self._next(), None
        if task is not None:
            worker.give(task)

    def _next(self) -> Work | None:
        if self._rest:
            return self._rest.popleft()
        task = next(self._tasks, None)
        return self._again.popleft() if task is None and self._again else task

    def _bury(self, worker: _Worker) -> Iterator[Row]:
        """Account for the runs of a worker that died."""
        how = worker.cause_of_death()
        if not worker.ready and worker.killed and self._stillborn < self.jobs:
            self._stillborn += 1  # somebody has ended it, or memory was short; once more
            if worker.first is not None:
                self._rest.append(worker.first)
            return
        if not worker.ready:
            raise SweepError(f"a worker process cannot start: {how}; its own words stand above")
        culprit, *others = worker.seeds
        if others:
            self._rest.append(replace(worker.task, seeds=tuple(others)))
        run = (worker.task.point, culprit)
        if run in self._suspects:
            yield failed_row(*run, f"its process died twice: {how}")
        else:
            self._suspects.add(run)
            self._again.append(replace(worker.task, seeds=(culprit,)))


class _Worker:
    """One process, its task, and the seeds of it whose rows are still to come."""

    def __init__(self, first: Work) -> None:
        self.first: Work | None = first  # for when it is ready
        self.task = first
        self.seeds: deque[int] = deque()
        self.ready = False
        self.pipe, theirs = multiprocessing.Pipe()
        # Not from the current folder, whatever lies there: the code that planned.
        command = [sys.executable, "-P", "-m", "dnnmso_mj.sweep.worker", str(theirs.fileno())]
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603  # no part of it comes from outside
                command,
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=2,  # whatever a controller prints is not the sweep's output
                env=os.environ | ONE_THREAD | {"PYTHONPATH": python_path()},
                start_new_session=True,  # Ctrl-C is for the sweep to handle
            )

    @property
    def busy(self) -> bool:
        """Whether it has something to say before it is given more to do."""
        return bool(self.seeds) or not self.ready

    def give(self, task: Work) -> None:
        self.task, self.seeds = task, deque(task.seeds)
        with suppress(OSError):  # it is dead, as the next message will tell
            self.pipe.send(task)

    def kill(self) -> None:
        self.pipe.close()
        if self._process.poll() is None:  # with what it has started, in its session of its own
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    @property
    def killed(self) -> bool:
        """Whether it was ended by a signal, after its end of the pipe has closed."""
        return self._process.wait() < 0

    def cause_of_death(self) -> str:
        """How the process ended, after its end of the pipe has closed."""
        self.pipe.close()
        code = self._process.wait()
        return signal.Signals(-code).name if code < 0 else f"exit status {code}"
