"""Rerun's programs as child processes: started, waited for, and never left behind."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from signal import SIGHUP, SIGTERM
from types import FrameType
from typing import IO, TYPE_CHECKING, TypeVar

from dnnmso_mj.errors import DnnmsoError, MissingExtraError
from dnnmso_mj.interrupts import heard

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

Result = TypeVar("Result")

LOCAL = "127.0.0.1"  # Rerun's own default, 0.0.0.0, would show the log to the whole network
_START_S = 60.0  # a busy machine that draws in software starts a viewer well within it
_POLL_S = 0.05
_END_S = 5.0
_NICE = 10
# Unlike `python -m rerun_cli` this passes the exit status on, and ends its process group when its
# standard input does: when we are gone, even if killed. A word on it lets the group live on.
_RERUN = """
import os, signal, sys, threading
from rerun_cli.__main__ import main
def follow():
    if not sys.stdin.read():
        os.killpg(0, signal.SIGTERM)
threading.Thread(target=follow, daemon=True).start()
sys.exit(main())
"""


@contextlib.contextmanager
def rerun(*arguments: str, bind: str = LOCAL) -> Iterator[RerunProcess]:
    """Run the command `rerun` with these arguments; end it, its children included, on leaving.

    Args:
        bind: the address that it listens on.
    """
    with tempfile.TemporaryFile() as messages:
        process = subprocess.Popen(  # noqa: S603
            [sys.executable, "-c", _RERUN, "--bind", bind, *arguments],
            # RERUN_APP_ONLY: no question about usage statistics at the first start.
            env={**os.environ, "RERUN_APP_ONLY": "true", "RUST_LOG": "error"},
            stdin=subprocess.PIPE,
            stdout=messages,
            stderr=messages,
            start_new_session=True,  # a group of its own: Ctrl-C is for us, and we end it all
        )
        running = RerunProcess(process, messages)
        try:
            yield running
        finally:
            if not running.released:
                _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_END_S)
            return


class RerunProcess:
    """A Rerun program that `rerun` started.

    Args:
        process: it.
        messages: the file that its output goes to.
    """

    def __init__(self, process: subprocess.Popen[bytes], messages: IO[bytes]) -> None:
        self.released = False
        self._process = process
        self._messages = messages

    def release(self) -> None:
        """Let it live on when `rerun` is left, and when we are gone."""
        self.released = True
        if self._process.stdin is not None:
            with contextlib.suppress(BrokenPipeError), self._process.stdin as word:
                word.write(b"live on")

    def give_way(self) -> None:
        """Let all else on this machine come first."""
        os.setpriority(os.PRIO_PGRP, self._process.pid, _NICE)

    def wait(self) -> None:
        """Wait for its end.

        Raises:
            DnnmsoError: it failed; says why.
        """
        if self._process.wait() != 0:
            raise DnnmsoError(f"Rerun's viewer failed: {self.complaint()}")

    def wait_until(self, ready: Callable[[], Result | None], what: str) -> Result:
        """Ask until an answer is true, and return it.

        Raises:
            DnnmsoError: the program ended first, or a minute has passed.
        """
        deadline = time.monotonic() + _START_S
        while time.monotonic() < deadline:
            if self._process.poll() is not None:
                raise DnnmsoError(f"Rerun's viewer ended before {what}: {self.complaint()}")
            if answer := ready():
                return answer
            time.sleep(_POLL_S)
        raise DnnmsoError(f"Rerun's viewer was not {what} after {_START_S:g} s. Try again.")

    def complaint(self) -> str:
        """What it said on its way out, in one line."""
        self._messages.seek(0)
        text = re.sub(r"\x1b\[[0-9;]*m", "", self._messages.read().decode(errors="replace"))
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        telling = [line for line in lines if "panicked at" in line or line.startswith("Error")]
        return (telling or lines or ["it gave no reason"])[-1]


@contextlib.contextmanager
def headless_viewer(rrd: Path, size: tuple[int, int]) -> Iterator[ViewerClient]:
    """A viewer without a window, that has loaded a recording, as a client to command it by.

    Args:
        rrd: the recording.
        size: width and height (pixels).

    Raises:
        MissingExtraError: the system has no Vulkan driver to draw with.
    """
    from rerun.experimental import ViewerClient

    port, (width, height) = free_port(), size
    arguments = ("--headless", "--port", str(port), "--window-size", f"{width}x{height}")
    with rerun(*arguments, str(rrd)) as process:

        def connected() -> ViewerClient | None:
            try:
                client = ViewerClient.connect(data_address(port))
                state = client.get_state()
            except (ConnectionError, RuntimeError):  # not yet
                return None
            loaded = not state.loading and any(r.timelines for r in state.recordings)
            return client if loaded else None

        try:
            client = process.wait_until(connected, "ready")
        except DnnmsoError as error:
            if "render context" in str(error) or "adapter" in str(error):
                raise MissingExtraError(
                    f"{error} A viewer without a window needs a Vulkan driver. On Debian and "
                    "Ubuntu: apt-get install mesa-vulkan-drivers libvulkan1"
                ) from error
            raise
        try:
            yield client
        except (ConnectionError, RuntimeError) as error:
            raise DnnmsoError(f"Rerun's viewer failed: {error}: {process.complaint()}") from error


def picture(client: ViewerClient) -> bytes:
    """What a viewer shows, as PNG, once it has stopped changing.

    Raises:
        DnnmsoError: a view reports that it cannot show its data, or the picture never settles.
    """
    deadline, last = time.monotonic() + _START_S, b""
    while time.monotonic() < deadline:
        shown = client.take_screenshot()
        if shown == last:
            break
        last = shown
    else:
        raise DnnmsoError(
            f"the viewer's picture was still changing after {_START_S:g} s. Try again."
        )
    problems = [f"{v.name}: {r.summary}" for v in client.get_state().views for r in v.reports]
    if problems:
        raise DnnmsoError("the viewer cannot show all views: " + "; ".join(problems))
    return shown


@contextlib.contextmanager
def until_interrupted() -> Iterator[None]:
    """Leave the block in good order at Ctrl-C, on SIGTERM, or when the terminal closes."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (SIGTERM, SIGHUP)}
    try:
        with contextlib.suppress(KeyboardInterrupt):
            yield
        heard()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def check_display(instead: str) -> None:
    """Refuse to open a window where there can be none.

    Args:
        instead: what to do then, as an imperative.

    Raises:
        DnnmsoError: there is no display.
    """
    shown = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform == "linux" and not shown:
        raise DnnmsoError(f"no display: neither DISPLAY nor WAYLAND_DISPLAY is set. {instead}")


def data_address(port: int, host: str = LOCAL) -> str:
    """Where the viewer that listens at a port of a machine is streamed to."""
    return f"rerun+http://{in_url(host)}:{port}/proxy"


def in_url(host: str) -> str:
    """An address as it stands in a URL."""
    return f"[{host}]" if ":" in host else host


def free_port(host: str = LOCAL) -> int:
    """A port of an address of this machine that nobody listens on."""
    with _probe(host) as probe:
        probe.bind((host, 0))
        return int(probe.getsockname()[1])


def listens(port: int, host: str = LOCAL) -> bool:
    """Whether somebody listens on a port of this machine."""
    with _probe(host) as probe:
        return probe.connect_ex((host, port)) == 0


def check_port(port: int, host: str = LOCAL) -> None:
    """Refuse a port that cannot be listened on.

    Raises:
        DnnmsoError: it is taken, or not ours to take; or the address is not this machine's.
    """
    try:
        with _probe(host) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except (OSError, OverflowError) as error:
        ours = "" if host == LOCAL else ", of an address of this machine"
        raise DnnmsoError(
            f"port {port} of {host} cannot be used: {error}. "
            f"Allowed: a free one, 1024 to 65535{ours}."
        ) from error


def _probe(host: str) -> socket.socket:
    return socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
