"""`dnnmso report`: tables and logs as one HTML page that needs nothing else."""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.files import write_whole
from dnnmso_mj.log.json_texts import read_json
from dnnmso_mj.log.opening import open_regular
from dnnmso_mj.report.page import Section, render
from dnnmso_mj.wording import clean

KINDS = "a table of `dnnmso sweep`, `compare` or `margins` (.parquet), or a log (.mcap)"
MCAP = b"\x89MCAP0\r\n"
PARQUET = b"PAR1"


class ReportError(DnnmsoError):
    """A report that cannot be made."""


def write_report(files: Sequence[Path], out: Path) -> None:
    """Write one self-contained page of what these files hold, in their order.

    The same files give the same bytes.

    Raises:
        ReportError: a file that is none of the known kinds or is damaged, or a page that cannot be
            written; then nothing is.
        LogError: a log that cannot be read.
    """
    if not files:
        raise ReportError(f"no file; allowed: {KINDS}")
    page = report_page(files, out.name).encode("utf-8", errors="backslashreplace")
    if any(file.exists() and out.exists() and file.samefile(out) for file in files):
        raise ReportError(f"--out {clean(str(out))}: is one of the files; allowed: another --out")
    try:
        write_whole(out, page)
    except OSError as error:
        raise ReportError(f"{clean(str(out))}: cannot be written: {error.strerror}") from error


def report_page(files: Sequence[Path], out_name: str) -> str:
    """The page as text; see `write_report`."""
    sections = [_section(file) for file in files]
    names = [file.name for file in files]
    command = shlex.join(["dnnmso", "report", *names, "--out", out_name])
    titles = "; ".join(section.title for section in sections)
    return render(titles, command, sections)


def _section(file: Path) -> Section:
    """What one file says, told apart by what it holds, not by its name."""
    name = clean(str(file))
    try:
        stream, _ = open_regular(file)
        with stream:
            beginning = stream.read(len(MCAP))
            stream.seek(0)
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise ReportError(f"{name}: cannot be read: {error.strerror}; allowed: {KINDS}") from error
    if beginning == MCAP:
        from dnnmso_mj.report.log import log_section

        section = log_section(file)
    elif beginning.startswith(PARQUET):
        section = _table_section(file, name)
    else:
        raise ReportError(f"{name}: neither a table nor a log; allowed: {KINDS}")
    return replace(section, facts=[("file", file.name), ("SHA-256", digest), *section.facts])


def _table_section(file: Path, name: str) -> Section:
    from dnnmso_mj.sweep.parquet import TableError, read_parquet
    from dnnmso_mj.sweep.table import LARGEST

    try:
        table = read_parquet(file)
        metadata = table.schema.metadata or {}
        for key, make in _makers().items():
            if key in metadata:
                return make(table, read_json(metadata[key].decode(), LARGEST))
    except TableError as error:
        raise ReportError(f"{name}: damaged: {clean(str(error))}; allowed: {KINDS}") from error
    except (ArithmeticError, LookupError, TypeError, ValueError, AttributeError) as error:
        problem = f"damaged: {type(error).__name__}: {clean(str(error))}"
        raise ReportError(f"{name}: {problem}; allowed: {KINDS}") from error
    raise ReportError(f"{name}: a table that no command of dnnmso wrote; allowed: {KINDS}")


def _makers() -> Mapping[bytes, Callable[[Any, Mapping[str, Any]], Section]]:
    """Key of a table's metadata -> what makes a section of it."""
    from dnnmso_mj.margins.run import MARGINS
    from dnnmso_mj.report.margins import margins_section
    from dnnmso_mj.sweep.table import SWEEP

    return {SWEEP.key: _runs_section, MARGINS.key: margins_section}


def _runs_section(table: Any, provenance: Mapping[str, Any]) -> Section:
    """A comparison is a sweep of controllers."""
    from dnnmso_mj.comparison.plan import COLUMN
    from dnnmso_mj.report.comparison import comparison_section
    from dnnmso_mj.report.runs import sweep_section

    compared = COLUMN in provenance["definition"]["points"][0]["parameters"]
    return (comparison_section if compared else sweep_section)(table, provenance)
