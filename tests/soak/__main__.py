"""`make soak`: every row of the scorecard, or one, and the page that shows them."""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from soak.proof import TESTS, measure, measure_apart
from soak.rows import ROWS, row_of
from soak.scorecard import keep, print_scorecard
from soak.tally import Form


def main() -> int:
    """Run rows one after the other; 1 if anything was lost or let in."""
    arguments = _arguments()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # what was begun ends
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # of a shell's background job
        signal.signal(signal.SIGINT, signal.default_int_handler)  # rows press Ctrl-C in programs
    form = Form(long=not arguments.short, seed=arguments.seed)
    if arguments.into:
        with tempfile.TemporaryDirectory(prefix="dnnmso-soak-") as folder:
            found = measure(row_of(arguments.row[0]), form, Path(folder))
        arguments.into.write_text(json.dumps(found))
        return 0
    # No row's matter: some of them judge what happens within seconds.
    subprocess.run([sys.executable, TESTS / "warm_up.py"], check=True)
    results = []
    for number in arguments.row or [row.number for row in ROWS]:
        print(f"row {number}: {row_of(number).title} …", flush=True)
        results.append(measure_apart(row_of(number), form))
        if form.long:
            keep(results[-1])
        said = {key: results[-1][key] for key in ("tried", "survived", "lost", "let_in", "seconds")}
        print(f"row {number}: " + ", ".join(f"{key} {value}" for key, value in said.items()))
    print_scorecard(results)
    return int(any(found["lost"] or found["let_in"] for found in results))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="make soak", description=__doc__)
    numbers = [row.number for row in ROWS]
    parser.add_argument("--row", type=int, action="append", choices=numbers, metavar="N")
    parser.add_argument("--short", action="store_true", help="the form that the tests run")
    parser.add_argument("--seed", type=int, default=0, help="of every random choice")
    parser.add_argument(
        "--into", type=Path, help="only one row, here, its result as JSON to a file"
    )
    arguments = parser.parse_args()
    if arguments.into and len(arguments.row or ()) != 1:
        parser.error("--into takes one --row")
    return arguments


if __name__ == "__main__":
    sys.exit(main())
