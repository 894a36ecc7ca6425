"""`--view` and `--serve`: a run in a viewer while it goes on."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Annotated

import typer

from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.wording import show

if TYPE_CHECKING:
    from dnnmso_mj.viewer.live import LiveView

View = Annotated[
    bool, typer.Option("--view", help="Show it live in a Rerun window, which stays afterwards.")
]
Serve = Annotated[
    bool, typer.Option("--serve", help="Show it live in a browser on this machine, until Ctrl-C.")
]
Port = Annotated[int, typer.Option(min=1, max=65535, help="Of --serve.")]
Bind = Annotated[
    str,
    typer.Option(help="IP address that --serve listens on; 0.0.0.0: whoever reaches it sees it."),
]
LOCAL = "127.0.0.1"


def live_view(
    view: bool, serve: bool, port: int, bind: str = LOCAL
) -> AbstractContextManager[LiveView | None]:
    """What shows a run while it goes on, if anything is to; its end waits for Ctrl-C at --serve.

    Raises:
        DnnmsoError: both are asked for, or an address without a page; on entering, as `viewer.live`
            has it.
    """
    require_page(serve, bind)
    if not view and not serve:
        return nullcontext()
    if view and serve:
        raise DnnmsoError("--view and --serve: allowed: one of them")
    from dnnmso_mj.viewer.live import served, window

    return served(port, bind) if serve else window()


def require_page(serve: bool, bind: str) -> None:
    """Refuse an address to listen on where nothing would.

    Raises:
        DnnmsoError: there is one.
    """
    if bind != LOCAL and not serve:
        raise DnnmsoError(f"--bind {show(bind)}: allowed: with --serve")
