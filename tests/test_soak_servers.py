"""Servers listen on this machine alone; and the check of that sees one that does not."""

from __future__ import annotations

import sys

import pytest
from soak.elsewhere import BESIDE, Elsewhere
from soak.proof import prove
from soak.servers import Server, try_server
from soak.tally import Tally

from dnnmso_mj.viewer.process import free_port

LISTEN = "import socket, sys, time; s = socket.create_server((sys.argv[1], int(sys.argv[2])))"
STAY, LEAVE = "; time.sleep(60)", "; time.sleep(0.2)"


def test_servers_listen_on_this_machine_alone(tmp_path):
    prove(9, tmp_path)


def tried(tmp_path, host: str, then: str, **options) -> Tally:
    tally = Tally()
    command = (sys.executable, "-c", LISTEN + then, host, str(free_port()))
    server = Server("a server", command, **options)
    try_server(server, tally, Elsewhere([BESIDE]), tmp_path)
    return tally


@pytest.mark.parametrize("told", [False, True])
def test_a_server_that_lets_everybody_in_is_lost(tmp_path, told):
    """Told or not: it does not say so."""
    assert not tried(tmp_path, "0.0.0.0", STAY, ports=1, told=told).passed


def test_a_server_that_lets_everybody_in_for_a_moment_is_let_in(tmp_path):
    tally = tried(tmp_path, "0.0.0.0", LEAVE)
    assert len(tally.let_in) == 1
    assert "0.0.0.0" in tally.let_in[0]


def test_a_server_of_a_child_of_another_session_is_seen(tmp_path):
    child = (
        "import subprocess, sys, time\n"
        f"command = [sys.executable, '-c', {LISTEN + STAY!r}, *sys.argv[1:]]\n"
        "subprocess.Popen(command, start_new_session=True)\n"
        "time.sleep(0.5)"
    )
    command = (sys.executable, "-c", child, "0.0.0.0", str(free_port()))
    tally = Tally()
    try_server(Server("a parent", command), tally, Elsewhere([BESIDE]), tmp_path)
    assert len(tally.let_in) == 1


def test_a_server_for_this_machine_passes(tmp_path):
    assert tried(tmp_path, "127.0.0.1", STAY, ports=1).passed


def test_a_page_that_should_be_open_to_others_and_is_not_is_lost(tmp_path):
    assert tried(tmp_path, "127.0.0.1", STAY, ports=1, told=True).lost
