"""The command `dnnmso`: every command is a few lines over the library, one file a group of them.

Exit status: 0 done; 1 the run diverged or a check failed; 2 bad input; 130 interrupted.
"""

from __future__ import annotations

import errno
import gc
import os
import signal
import sys
import warnings
from io import TextIOWrapper
from typing import Annotated, NoReturn

import typer
from typer.completion import completion_init

from dnnmso_mj.cli import (
    audit,
    bench,
    check,
    compare,
    completion,
    doctor,
    logs,
    margins,
    report,
    resume,
    run,
    scenarios,
    sweep,
    tune,
)
from dnnmso_mj.cli.shared import BAD_INPUT, INTERRUPTED, say
from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.extras import extra_of, pip_install
from dnnmso_mj.interrupts import remember_presses

COMPLETE = "_DNNMSO_COMPLETE"  # set by a shell that asks for completions

app = typer.Typer(
    help="Run, prove, replay and measure the DNN-MSO controller on a MuJoCo arm.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def main() -> NoReturn:
    """Entry point: run the command line; people's errors are one message and status 2."""
    # Imports make objects by the hundred thousand and hardly any garbage: half a second of a start.
    gc.set_threshold(100_000, 50, 100)
    remember_presses()
    warnings.showwarning = _Warnings().show
    warnings.simplefilter("always", UserWarning)
    _degrade()
    if COMPLETE in os.environ:
        completion_init()
    status = _run()
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        status = _refused_output(error)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done and said
    gc.freeze()  # nothing is left to collect that the end of the process would not free
    sys.exit(status)


def _run() -> int:
    """The exit status of the command, its errors told."""
    try:
        app(prog_name="dnnmso")
    except SystemExit as end:
        if end.code == INTERRUPTED:
            # typer turns KeyboardInterrupt into this, and says nothing.
            cause = getattr(end.__context__, "__cause__", None)
            print(f"interrupted; {cause}" if str(cause or "") else "interrupted", file=sys.stderr)
        return end.code if isinstance(end.code, int) else 0
    except DnnmsoError as error:
        say("error", str(error))
    except OSError as error:
        if error.filename is None and error.errno in FULL:
            return _refused_output(error)
        say("error", f"{error.filename or ''}: {error.strerror}")
    except Exception as error:
        if _interrupted(error):
            print("interrupted", file=sys.stderr)
            return INTERRUPTED
        name = (error.name or "") if isinstance(error, ImportError) else ""
        if extra := extra_of(name):
            say("error", f"{name} is not installed: {pip_install(extra)}")
        elif "cannot cache function" in str(error):
            say("error", NO_CACHE)
        else:
            raise
    return BAD_INPUT


def _interrupted(error: BaseException | None) -> bool:
    """Whether Ctrl-C is behind an error: libraries make others of it."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}

NO_CACHE = (
    "no folder where numba may keep compiled code: neither the package's nor the one in your home "
    "can be written; allowed: the environment variable NUMBA_CACHE_DIR set to a folder that can be"
)


def _degrade() -> None:
    """Print what an output's encoding lacks as '?', rather than fail on it."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="replace")


def _refused_output(error: OSError) -> int:
    """Say so, and drop what is left, or Python would complain once more at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    if error.errno == errno.EPIPE:
        return 1  # nobody reads on, as after `| head`
    print(f"error: standard output cannot be written: {error.strerror}", file=sys.stderr)
    return BAD_INPUT


class _Warnings:
    """Shows each of people's warnings once, as one line."""

    def __init__(self) -> None:
        self._shown: set[str] = set()

    def show(
        self, message: Warning | str, category: type[Warning], *_place: object, **_file: object
    ) -> None:
        if issubclass(category, UserWarning) and str(message) not in self._shown:
            self._shown.add(str(message))
            say("warning", str(message))


def _print_version(wanted: bool) -> None:
    if wanted:
        from dnnmso_mj import __version__

        print(__version__)
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    pass


# In the order of the help.
app.command()(run.run)
app.command()(sweep.sweep)
app.command()(compare.compare)
app.command()(margins.margins)
app.command()(tune.tune)
app.command()(report.report)
app.command()(audit.audit)
app.command()(check.check)
app.command()(logs.plot)
app.command()(logs.replay)
app.command()(logs.info)
app.command()(logs.recover)
app.command()(resume.resume)
app.command()(resume.diff)
app.command()(scenarios.schema)
app.command()(scenarios.scenarios)
app.command()(scenarios.controllers)
app.command()(scenarios.new)
app.command()(bench.bench)
app.command()(doctor.doctor)
app.command()(completion.completion)
