"""`dnnmso report`: tables and logs as one page that needs nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dnnmso_mj.cli.completing import complete_log
from dnnmso_mj.cli.shared import near, working
from dnnmso_mj.extras import require
from dnnmso_mj.paths import find_log


def _table_or_log(source: str) -> Path:
    return Path(source) if source.endswith(".parquet") else find_log(source)


def report(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...",
            parser=_table_or_log,
            autocompletion=complete_log,
            help="Tables (.parquet) or logs (.mcap, or names), in the page's order.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="The page.")] = Path("report.html"),
) -> None:
    """Make one self-contained HTML page of tables and logs."""
    require("report", "dnnmso report")
    from dnnmso_mj.report import write_report

    with working("drawing the page"):
        write_report(files, out)
    print(near(out))
