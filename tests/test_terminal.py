"""Colour where a person looks on, and none in a pipe or a file: with a real terminal and a pipe."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import pytest

DNNMSO = str(Path(sys.executable).with_name("dnnmso"))
TABLE, ERROR, HELP = ("scenarios",), ("info", "paper"), ("--help",)
ESCAPE = "\x1b["
COLOUR = r"\x1b\[(1;)?3[0-7]m"
CLEAN = {
    name: value
    for name, value in os.environ.items()
    if name not in {"NO_COLOR", "FORCE_COLOR", "PY_COLORS", "GITHUB_ACTIONS", "COLUMNS"}
} | {"TERM": "xterm"}


def on_a_terminal(args: tuple[str, ...], folder: Path, **more: str) -> str:
    """What a command shows on a terminal, output and errors."""
    parent, child = pty.openpty()
    command = [DNNMSO, *args]
    process = subprocess.Popen(
        command, cwd=folder, env=CLEAN | more, stdin=child, stdout=child, stderr=child
    )
    os.close(child)
    shown = b""
    try:
        while True:
            try:
                shown += os.read(parent, 65536)
            except OSError:  # the terminal closes when the process ends
                break
        process.wait(timeout=60)
    finally:
        process.kill()
        os.close(parent)
    return shown.decode()


def in_a_pipe(args: tuple[str, ...], folder: Path, **more: str) -> str:
    done = subprocess.run(
        [DNNMSO, *args],
        cwd=folder,
        env=CLEAN | more,
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout + done.stderr


@pytest.mark.parametrize("args", [TABLE, ERROR], ids=["table", "error"])
def test_a_terminal_gets_colour_unless_it_asks_for_none(args, tmp_path):
    assert ESCAPE + "1" in on_a_terminal(args, tmp_path)
    for more in ({"NO_COLOR": "1"}, {"TERM": "dumb"}):
        plain = on_a_terminal(args, tmp_path, **more)
        assert not re.search(COLOUR, plain), more
        assert "paper" in plain


@pytest.mark.parametrize("args", [TABLE, ERROR, HELP, ("fly",)], ids=lambda args: args[0])
def test_a_pipe_gets_none_unless_it_asks_for_some(args, tmp_path):
    assert ESCAPE not in in_a_pipe(args, tmp_path)
    forced = in_a_pipe(args, tmp_path, NO_COLOR="1", FORCE_COLOR="1")
    assert not re.search(COLOUR, forced)
    if args in (TABLE, ERROR):
        assert ESCAPE in in_a_pipe(args, tmp_path, FORCE_COLOR="1")


def test_an_error_is_the_same_text_with_colour_and_without(tmp_path):
    plain = in_a_pipe(ERROR, tmp_path)
    coloured = on_a_terminal(ERROR, tmp_path).replace("\r\n", "\n")
    assert plain.startswith("error: paper: no such log")
    assert coloured == plain.replace("error", "\x1b[1;31merror\x1b[0m", 1)


def test_files_never_hold_colour(tmp_path):
    shown = on_a_terminal(("new", "mine"), tmp_path, FORCE_COLOR="1")
    assert "dnnmso run mine.yaml" in shown
    assert ESCAPE not in (tmp_path / "mine.yaml").read_text()
    with (tmp_path / "table").open("w") as out:
        subprocess.run([DNNMSO, *TABLE], cwd=tmp_path, env=CLEAN, stdout=out, check=True)
    assert ESCAPE not in (tmp_path / "table").read_text()


def test_a_table_fits_a_terminal_and_is_whole_in_a_pipe(tmp_path):
    narrow = on_a_terminal(("scenarios",), tmp_path, COLUMNS="80", NO_COLOR="1")
    plain = re.sub(r"\x1b\[[0-9;]*m", "", narrow)  # NO_COLOR leaves what is bold
    assert max(len(line.rstrip()) for line in plain.splitlines()) <= 80
    whole = in_a_pipe(("scenarios",), tmp_path)
    line = next(line for line in whole.splitlines() if line.startswith("hard_delay "))
    assert line.rstrip().endswith(
        "[torque_limit, actuator_delay, position_noise, velocity_noise, payload]"
    )
