"""The viewer as a page for browsers: on this machine, or where else they may reach it."""

from __future__ import annotations

import contextlib
import socket
import urllib.parse
import urllib.request
from collections.abc import Iterator
from http import HTTPStatus
from ipaddress import IPv6Address, ip_address
from typing import NamedTuple

from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.viewer.process import (
    LOCAL,
    RerunProcess,
    check_port,
    data_address,
    free_port,
    in_url,
    listens,
    rerun,
)
from dnnmso_mj.wording import show


class WebServer(NamedTuple):
    """Rerun's server for browsers.

    Args:
        process: it.
        page: the address for a browser.
        data: the address to stream to, from this machine.
        exposed: who else reaches it, as a sentence; "" if nobody does.
    """

    process: RerunProcess
    page: str
    data: str
    exposed: str


@contextlib.contextmanager
def web_server(port: int, *recordings: str, bind: str = LOCAL) -> Iterator[WebServer]:
    """Serve a page with the viewer; unless told otherwise to browsers on this machine alone.

    Args:
        port: of the page.
        recordings: what it shows beside what is streamed to it.
        bind: the IP address to listen on; whoever reaches it sees the page, without a password.

    Raises:
        DnnmsoError: no such address or port can be listened on, or the server cannot start.
    """
    here, shown = _hosts(bind)
    check_port(port, bind)
    data_port = free_port(bind)
    page, data = f"http://{in_url(shown)}:{port}", data_address(data_port, shown)
    arguments = ["--serve-web", "--web-viewer-port", str(port), "--port", str(data_port)]
    exposed = ""
    if not _is_loopback(bind):
        where = "any of its addresses" if here != shown else shown
        exposed = (
            f"Whoever reaches this machine at {where}, ports {port} and {data_port}, sees what is "
            "shown and can add to it: there is no password."
        )
        arguments += ["--cors-allow-origin", page]
    asked = f"http://{in_url(here)}:{port}"
    with rerun(*arguments, *recordings, bind=bind) as server:
        server.wait_until(lambda: listens(data_port, here) and _answers(asked), "ready")
        address = f"{page}/?url={urllib.parse.quote(data, safe='')}"
        yield WebServer(server, address, data_address(data_port, here), exposed)


def check_bind(bind: str) -> None:
    """Refuse what is no IP address.

    Raises:
        DnnmsoError: it is none.
    """
    try:
        ip_address(bind)
    except ValueError as error:
        raise DnnmsoError(
            f"--bind {show(bind)}: no IP address; allowed: {LOCAL} (this machine alone), another "
            "address of this machine, or 0.0.0.0 (all of them)"
        ) from error


def _hosts(bind: str) -> tuple[str, str]:
    """Where this machine reaches what listens on an address, and where others do."""
    check_bind(bind)
    if not ip_address(bind).is_unspecified:
        return bind, bind
    family, far, loopback = (
        (socket.AF_INET6, "2001:db8::1", "::1")
        if ":" in bind
        else (socket.AF_INET, "192.0.2.1", LOCAL)
    )
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((far, 9))  # sends nothing: asks which way leads out
        except OSError:
            return loopback, loopback
        return loopback, str(probe.getsockname()[0])


def _is_loopback(bind: str) -> bool:
    address = ip_address(bind)
    inner = address.ipv4_mapped if isinstance(address, IPv6Address) else None
    return (inner or address).is_loopback


def _answers(page: str) -> bool:
    try:
        with urllib.request.urlopen(page, timeout=1.0) as response:  # noqa: S310
            return bool(response.status == HTTPStatus.OK)
    except OSError:
        return False
