"""The viewer as a page for browsers on this machine."""

from __future__ import annotations

import contextlib
import urllib.parse
import urllib.request
from collections.abc import Iterator
from http import HTTPStatus
from typing import NamedTuple

from dnnmso_mj.viewer.process import (
    LOCAL,
    RerunProcess,
    check_port,
    data_address,
    free_port,
    listens,
    rerun,
)


class WebServer(NamedTuple):
    """Rerun's server for browsers.

    Args:
        process: it.
        page: the address for a browser.
        data: the address to stream to.
    """

    process: RerunProcess
    page: str
    data: str


@contextlib.contextmanager
def web_server(port: int, *recordings: str) -> Iterator[WebServer]:
    """Serve a page with the viewer, to browsers on this machine and to no others.

    Args:
        port: of the page.
        recordings: what it shows beside what is streamed to it.

    Raises:
        DnnmsoError: the port is taken, or the server cannot start.
    """
    check_port(port)
    data_port, page = free_port(), f"http://{LOCAL}:{port}"
    data = data_address(data_port)
    arguments = ("--serve-web", "--web-viewer-port", str(port), "--port", str(data_port))
    with rerun(*arguments, *recordings) as server:
        server.wait_until(lambda: listens(data_port) and _answers(page), "ready")
        yield WebServer(server, f"{page}/?url={urllib.parse.quote(data, safe='')}", data)


def _answers(page: str) -> bool:
    try:
        with urllib.request.urlopen(page, timeout=1.0) as response:  # noqa: S310
            return bool(response.status == HTTPStatus.OK)
    except OSError:
        return False
