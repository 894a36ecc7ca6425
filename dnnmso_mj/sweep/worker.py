"""A worker process: tasks come in by a pipe, rows go out by it.

`python -m dnnmso_mj.sweep.worker FD`, started by `dnnmso_mj.sweep.local` with FD as one end of the
pipe. It ends when the other end is closed, so it never outlives its sweep by more than one run.
"""

from __future__ import annotations

import sys
import warnings
from contextlib import suppress
from multiprocessing.connection import Connection


def main() -> None:
    """Serve tasks until the pipe is closed."""
    pipe = Connection(int(sys.argv[1]))
    warnings.simplefilter("ignore")  # the plan has warned; an overflow before a divergence is data
    from dnnmso_mj.sweep.task import Work  # what cannot be imported is told before any run

    with suppress(EOFError, ConnectionError):
        pipe.send("ready")
        while True:
            work: Work = pipe.recv()
            for row in work():
                pipe.send(row)


if __name__ == "__main__":
    main()
