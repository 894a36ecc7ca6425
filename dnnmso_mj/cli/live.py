"""`--view` and `--serve`: a run in a viewer while it goes on."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Annotated

import typer

from dnnmso_mj.errors import DnnmsoError

if TYPE_CHECKING:
    from dnnmso_mj.viewer.live import LiveView

View = Annotated[
    bool, typer.Option("--view", help="Show it live in a Rerun window, which stays afterwards.")
]
Serve = Annotated[
    bool, typer.Option("--serve", help="Show it live in a browser on 127.0.0.1, until Ctrl-C.")
]
Port = Annotated[int, typer.Option(min=1, max=65535, help="Of --serve.")]


def live_view(view: bool, serve: bool, port: int) -> AbstractContextManager[LiveView | None]:
    """What shows a run while it goes on, if anything is to; its end waits for Ctrl-C at --serve.

    Raises:
        DnnmsoError: both are asked for; on entering, as `viewer.live` has it.
    """
    if not view and not serve:
        return nullcontext()
    if view and serve:
        raise DnnmsoError("--view and --serve: allowed: one of them")
    from dnnmso_mj.viewer.live import served, window

    return served(port) if serve else window()
