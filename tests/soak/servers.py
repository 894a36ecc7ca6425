"""Row 9: what listens, listens on this machine alone; told otherwise, it says so.

Real sockets are looked at a hundred times a second, from the start of each program to its end, of
every process that it has started; and its ports are knocked at from this machine's other addresses
and from another network.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from dnnmso_mj.viewer.process import free_port
from soak import ended
from soak.elsewhere import Elsewhere, elsewhere
from soak.proof import TESTS
from soak.sockets import Watch, watched
from soak.tally import Form, Tally

START_S, END_S = 90.0, 30.0
DNNMSO = (sys.executable, "-P", "-m", "dnnmso_mj")
RUN = ("run", "paper_no_network", "--set", "duration=0.2", "--no-plot", "--force")
REFUSED = ("", "nonsense", "127.0.0.1.nip.io", "0", "256.0.0.1", "127.0.0.1:80", "203.0.113.7")
WARNING = "there is no password"


@dataclass
class Server:
    """A program that may listen.

    Args:
        what: it is, for the scorecard.
        command: that starts it.
        ports: how many ports it has, once it is up; 0 for one that ends by itself.
        told: whether it was told to let others in; it must then say so.
    """

    what: str
    command: tuple[str, ...]
    ports: int = 0
    told: bool = False
    seen: Watch = field(default_factory=Watch)


def run(form: Form, tally: Tally, folder: Path) -> None:
    with elsewhere() as others:
        tally.figure("knocked from", [*others.hosts, *(["a network"] if others.network else [])])
        log = folder / "log.mcap"
        first = ended.dnnmso(*RUN, "--out", log)
        assert first.status == 0, first.err
        for server in [*_served(log, folder), *_others(form, log, folder)]:
            try_server(server, tally, others, folder)
    for word in form.pick(REFUSED[:2], REFUSED):
        with tally.case(f"--bind {word!r} is refused"):
            what = ("replay", log, "--serve") if len(word) % 2 else (*RUN, "--serve")
            assert ended.dnnmso(*what, "--bind", word, cwd=folder).is_one_error


def _served(log: Path, folder: Path) -> Iterator[Server]:
    """Pages: of a run and of a log, to this machine and to all."""
    live = (*DNNMSO, *RUN, "--out", str(folder / "live.mcap"), "--serve", "--port")
    replay = (*DNNMSO, "replay", str(log), "--serve", "--port")
    everybody = (*replay, str(free_port()), "--bind", "0.0.0.0")
    yield Server("run --serve", (*live, str(free_port())), 2)
    yield Server("replay --serve --bind 0.0.0.0", everybody, 2, True)
    yield Server("the documentation", docs_command(), 1)


def _others(form: Form, log: Path, folder: Path) -> Iterator[Server]:
    """What is slower to start, and what need not listen at all."""
    if not form.long:
        return
    live = (*DNNMSO, *RUN, "--out", str(folder / "live.mcap"), "--serve", "--port")
    replay = (*DNNMSO, "replay", str(log))
    yield Server("run --serve --bind ::", (*live, str(free_port()), "--bind", "::"), 2, True)
    yield Server("replay --serve", (*replay, "--serve", "--port", str(free_port())), 2)
    yield Server("replay --screenshot", (*replay, "--screenshot", str(folder / "shot.png")))
    display = (shutil.which("xvfb-run") or "xvfb-run", "-a")
    view = (*display, *DNNMSO, *RUN, "--out", str(folder / "view.mcap"), "--view")
    yield Server("run --view", view)
    yield Server("replay in a window", (*display, *replay), 1)
    sweep = (*DNNMSO, "sweep", "paper_no_network", "--seeds", "0:4", "--set", "duration=0.2")
    sweep += ("--jobs", "2", "--out")
    yield Server("a sweep", (*sweep, str(folder / "local.parquet")))
    yield Server("a sweep on Ray", (*sweep, str(folder / "ray.parquet"), "--engine", "ray"))


def docs_command() -> tuple[str, ...]:
    """What the Makefile says serves the documentation, on a free port."""
    makefile = (TESTS.parent / "Makefile").read_text()
    found = re.search(r"-m http\.server[^\"\n]*", makefile)
    assert found, "the Makefile names no server of the documentation"
    words = shlex.split(found[0].replace("--directory site", "--directory docs"))
    return sys.executable, *words, str(free_port())


def try_server(server: Server, tally: Tally, others: Elsewhere, folder: Path) -> None:
    """Start it, look on, knock, end it; one case."""
    if not shutil.which(server.command[0]):
        tally.leave_out(server.what, f"there is no {server.command[0]} here")
        return
    with tally.case(server.what):
        with watched() as server.seen, _running(server, folder) as said:
            if server.ports:
                _knock(server, others, said)
        _judge(server, said(), tally)
        tally.figure(f"{server.what}: sockets", len(server.seen.sockets))


@contextmanager
def _running(server: Server, folder: Path) -> Iterator[Callable[[], str]]:
    """The program, up or over; what it has said so far. It and all it started are ended."""
    words = folder / "said.txt"
    with words.open("wb") as out:
        process = subprocess.Popen(
            server.command,
            cwd=TESTS.parent,
            env=server.seen.environment,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=out,
            start_new_session=True,
        )
    try:
        until = time.monotonic() + START_S
        while time.monotonic() < until and process.poll() is None:
            if server.ports and len(server.seen.sockets) >= server.ports and _is_up(server, words):
                break
            time.sleep(0.02)
        else:
            assert not server.ports, f"never up: {words.read_text()[-500:]}"
        assert process.returncode in (None, 0), words.read_text()[-500:]
        yield words.read_text
    finally:
        _end(server, process)


def _is_up(server: Server, words: Path) -> bool:
    """Whether it has said where it is, if it says so at all."""
    return "--serve" not in server.command or "Ctrl-C" in words.read_text()


def _end(server: Server, process: subprocess.Popen[bytes]) -> None:
    for number in (signal.SIGINT, signal.SIGKILL):
        for pid in server.seen.processes():
            with suppress(ProcessLookupError):
                os.kill(int(pid), number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(END_S)
            break
    for pid in server.seen.processes():  # what its end has left behind
        with suppress(ProcessLookupError):
            os.kill(int(pid), signal.SIGKILL)


def _knock(server: Server, others: Elsewhere, said: Callable[[], str]) -> None:
    """From elsewhere: nobody answers, or at least one does where that is wanted."""
    for port in {socket.port for socket in server.seen.sockets}:
        reached = others.reaches(port)
        if server.told:
            assert reached, f"port {port} cannot be reached, though others were let in: {said()}"
        else:
            assert not reached, f"port {port} is reached at {reached}"


def _judge(server: Server, said: str, tally: Tally) -> None:
    assert server.seen.looks >= 3, f"looked {server.seen.looks} times only"
    assert len(server.seen.sockets) >= server.ports, f"{len(server.seen.sockets)} sockets seen"
    if server.told:
        assert WARNING in said, f"did not say so: {said}"
        assert server.seen.open_to_others, "nothing was open to others, though it was told so"
        return
    assert WARNING not in said, f"said so untold: {said}"
    for socket in server.seen.open_to_others:
        tally.admit(f"{server.what}: {socket}")
