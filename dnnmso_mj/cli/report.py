"""`dnnmso report`: tables and logs as one page that needs nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dnnmso_mj.cli.shared import near, working


def report(
    files: Annotated[
        list[Path], typer.Argument(help="Tables (.parquet) or logs (.mcap), in the page's order.")
    ],
    out: Annotated[Path, typer.Option(help="The page.")] = Path("report.html"),
) -> None:
    """Make one self-contained HTML page of tables and logs."""
    from dnnmso_mj.report import write_report

    with working("drawing the page"):
        write_report(files, out)
    print(near(out))
