"""A run in a Rerun viewer while it goes on: in a window, in a browser, or in any given viewer.

The loop only copies its rows into a ring; a process of its own, `streamer`, makes of them what
Rerun takes, and waits for the viewer. So no viewer, however slow, stopped or gone, holds up a run.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, Pipe
from typing import Any, TypeAlias

import numpy as np

from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.extras import require
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.scene import Scene
from dnnmso_mj.sources import python_path
from dnnmso_mj.trace import Event, RunInfo, StepLayout
from dnnmso_mj.viewer.process import (
    LOCAL,
    RerunProcess,
    check_display,
    data_address,
    free_port,
    listens,
    rerun,
    until_interrupted,
)
from dnnmso_mj.viewer.ring import Ring, shared_memory
from dnnmso_mj.viewer.web import web_server
from dnnmso_mj.viewer.wire import ending, event_bytes, opening, snapshot_bytes

Array = np.ndarray
Control: TypeAlias = "Connection[Any, Any]"

STREAMER = "dnnmso_mj.viewer.streamer"
BACKLOG_BYTES = 64 * 2**20  # that may wait for the viewer; what is more is left out
ROWS, EVENT, SNAPSHOT = range(3)  # kinds of messages
_START_S = 60.0  # a busy machine starts Python and Rerun well within it
_SETTLE_S = 1.0  # no longer than the streamer takes to start
_PATIENCE_S = 3.0  # after the run, with a viewer that takes nothing


class LiveView:
    """A recorder that streams a run to a viewer, and never waits for it.

    `begin` comes before the run's first row and `end` after its last. What the viewer has not got
    by then, since it was closed or too slow, it never gets: a warning says how much that is.

    Args:
        ring: takes what the run says, as `streamer` reads it.
        process: that streamer.
        control: to tell it what is run, and when that is over.
    """

    def __init__(self, ring: Ring, process: RerunProcess, control: Control) -> None:
        self._ring, self._process, self._control = ring, process, control
        self._ticks = 0

    @property
    def ticks(self) -> int:
        """Number of ticks taken so far."""
        return self._ticks

    def begin(self, scenario: Scenario, scene: Scene, layout: StepLayout) -> None:
        """Tell what will be run, and wait until its rows can be taken.

        Raises:
            DnnmsoError: the process that streams cannot start.
        """
        self._ring.warm(8 * layout.width * scenario.n_ticks)
        try:
            self._control.send_bytes(opening(scenario, scene, layout))
            if not self._control.poll(_START_S):
                raise DnnmsoError(f"the live view was not ready after {_START_S:g} s. Try again.")
            self._control.recv_bytes()
        except (EOFError, OSError) as error:
            why = self._process.complaint()
            raise DnnmsoError(f"the live view cannot start: {why}") from error

    def append(self, rows: Array) -> None:
        """Take a block of ticks, rows (m, width), if there is room for it."""
        self._ring.put(ROWS, rows.data.cast("B"))
        self._ticks += len(rows)

    def event(self, event: Event) -> None:
        """Take an event."""
        self._ring.put(EVENT, event_bytes(event))

    def snapshot(self, name: str, t: float, arrays: Mapping[str, Array]) -> None:
        """Take the controller's state at time t (s); other snapshots are for logs."""
        if name == "controller":
            self._ring.put(SNAPSHOT, snapshot_bytes(t, arrays))

    def end(self, info: RunInfo) -> None:
        """Tell how the run went; wait until the viewer has got it all, or takes no more."""
        why = self._deliver(info)
        missed = self._ticks - self._ring.tally
        if missed:
            lost = f"the viewer did not get {missed:,} of {self._ticks:,} ticks, since {why}"
            warnings.warn(f"{lost}; the log has them all", stacklevel=2)

    def _deliver(self, info: RunInfo) -> str:
        """Have all that waits brought to the viewer; says why it may not have got everything."""
        with suppress(EOFError, OSError):
            self._control.send_bytes(ending(info))
            delivered = -1
            while delivered < self._ring.tally:
                delivered = self._ring.tally
                if self._control.poll(_PATIENCE_S):
                    self._control.recv_bytes()  # "done"
                    break
            return "it took them too slowly, or not at all"
        return "it is gone" if self._ring.closed else self._process.complaint()


@contextmanager
def connected(address: str, backlog: int = BACKLOG_BYTES) -> Iterator[LiveView]:
    """A view in a viewer that runs somewhere, or does not.

    Args:
        address: as "rerun+http://127.0.0.1:9876/proxy".
        backlog: bytes that may wait for it.

    Raises:
        MissingExtraError: rerun is not installed.
    """
    require("viewer", "the viewer")
    memory = shared_memory(backlog)
    control, its_control = Pipe()
    with tempfile.TemporaryFile() as messages, control:
        handed = (memory, its_control.fileno())
        process = subprocess.Popen(  # noqa: S603
            [sys.executable, "-P", "-m", STREAMER, *map(str, handed), address],
            env={**os.environ, "PYTHONPATH": _import_path(), "RUST_LOG": "off"},
            stdin=subprocess.DEVNULL,
            stdout=messages,
            stderr=messages,
            pass_fds=handed,
            start_new_session=True,  # Ctrl-C is for us, and we end it
        )
        ring = Ring(memory)
        os.close(memory)
        its_control.close()
        try:
            yield LiveView(ring, RerunProcess(process, messages), control)
        finally:
            process.kill()
            process.wait()


def _import_path() -> str:
    """A PYTHONPATH by which the streamer finds all that this process finds: a plug-in, too."""
    return os.pathsep.join([python_path(), *sys.path])


@contextmanager
def window() -> Iterator[LiveView]:
    """A view in a window of its own, which stays open when the block is left.

    Raises:
        DnnmsoError: there is no display, or the viewer cannot start.
        MissingExtraError: rerun is not installed.
    """
    require("viewer", "the viewer")
    check_display("Use --serve (a browser), or run without --view and `dnnmso replay` the log")
    with started("--hide-welcome-screen", "--expect-data-soon") as live:
        yield live


@contextmanager
def served(port: int, bind: str = LOCAL) -> Iterator[LiveView]:
    """A view for browsers, also after the block, until Ctrl-C.

    The page's address is printed on standard error, and who reaches it beside this machine.

    Args:
        port: of the page.
        bind: the IP address to listen on.

    Raises:
        DnnmsoError: the port is taken, or the server cannot start.
        MissingExtraError: rerun is not installed.
    """
    require("viewer", "the viewer")
    with web_server(port, bind=bind) as server:
        server.process.give_way()
        print(f"live     {server.page}", file=sys.stderr, flush=True)
        if server.exposed:
            print(server.exposed, file=sys.stderr, flush=True)
        with connected(server.data) as live:
            yield live
        print("The page stays until Ctrl-C.", file=sys.stderr, flush=True)
        with until_interrupted():
            server.process.wait()


@contextmanager
def started(*arguments: str) -> Iterator[LiveView]:
    """A view in a viewer started with these arguments, which stays if there was a run."""
    port = free_port()
    with rerun("--port", str(port), *arguments) as viewer:
        viewer.give_way()
        viewer.wait_until(lambda: listens(port), "ready")
        with connected(data_address(port)) as live:
            # It listens before it has a window, and ends if it can have none.
            settled = time.monotonic() + _SETTLE_S
            viewer.wait_until(lambda: time.monotonic() > settled, "ready")
            try:
                yield live
            finally:
                if live.ticks:
                    viewer.release()
