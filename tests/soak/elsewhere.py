"""Places from which others would reach this machine: its other addresses, and another network."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from ipaddress import ip_address

PATIENCE_S = 2.0
BESIDE = "127.0.0.2"  # what listens on 127.0.0.1 alone does not hear it; what listens on all does
KNOCK = """
import json, socket, sys
def answers(host, port):
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as probe:
        probe.settimeout(float(sys.argv[1]))
        return probe.connect_ex((host, port)) == 0
for line in sys.stdin:
    print(json.dumps([door for door in json.loads(line) if answers(*door)]), flush=True)
"""


class Elsewhere:
    """Knocks at this machine's doors: from itself by its other addresses, and from a network.

    Args:
        hosts: addresses that others know this machine by.
        network: a process in another network namespace, and this machine's address there.
    """

    def __init__(
        self, hosts: list[str], network: tuple[subprocess.Popen[str], str] | None = None
    ) -> None:
        self.hosts, self.network = hosts, network

    def reaches(self, port: int) -> list[str]:
        """The addresses at which somebody answers at a port."""
        found = [host for host in self.hosts if _answers(host, port)]
        if self.network is not None:
            process, host = self.network
            answered = _ask(process, [[host, port]])
            found += [f"{name} of another network" for name, _ in answered]
        return found


@contextmanager
def elsewhere() -> Iterator[Elsewhere]:
    """Other addresses of this machine; and a namespace behind a cable, where one may be made."""
    hosts = [BESIDE, *_other_addresses()]
    if os.geteuid() != 0 or not all(map(shutil.which, ("unshare", "ip", "nsenter"))):
        yield Elsewhere(hosts)
        return
    # The namespace and its cable end with the process.
    process = subprocess.Popen(
        ["unshare", "--net", sys.executable, "-c", KNOCK, str(PATIENCE_S)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        host = _lay_cable(process)
        yield Elsewhere(hosts, (process, host) if host else None)
    finally:
        process.kill()
        process.communicate()


def _lay_cable(process: subprocess.Popen[str]) -> str | None:
    """Join a process's network namespace to ours; this machine's address there, None if refused."""
    _ask(process, [])  # it answers once it is in its namespace
    pid, name = str(process.pid), f"soak{process.pid % 100_000}"
    net = f"10.213.{process.pid // 256 % 256}"
    commands = [
        ["ip", "link", "add", name, "type", "veth", "peer", "name", "cable", "netns", pid],
        ["ip", "addr", "add", f"{net}.1/24", "dev", name],
        ["ip", "link", "set", name, "up"],
        ["nsenter", "-t", pid, "-n", "ip", "addr", "add", f"{net}.2/24", "dev", "cable"],
        ["nsenter", "-t", pid, "-n", "ip", "link", "set", "cable", "up"],
    ]
    for command in commands:
        if subprocess.run(command, capture_output=True, check=False).returncode != 0:
            return None
    return f"{net}.1"


def _ask(process: subprocess.Popen[str], doors: list[list[str | int]]) -> list[list[str | int]]:
    """Those of some doors that open to the process that `KNOCK` runs in."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(json.dumps(doors) + "\n")
    process.stdin.flush()
    answered: list[list[str | int]] = json.loads(process.stdout.readline())
    return answered


def _other_addresses() -> list[str]:
    """Addresses of this machine that others may know."""
    try:
        said = subprocess.run(["ip", "-json", "addr"], capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return []
    found = [info["local"] for link in json.loads(said) for info in link.get("addr_info", ())]
    own = [ip_address(host) for host in found]
    return [str(host) for host in own if not (host.is_loopback or host.is_link_local)]


def _answers(host: str, port: int) -> bool:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as probe:
        probe.settimeout(PATIENCE_S)
        return probe.connect_ex((host, port)) == 0
