"""The rows of the scorecard, in the order that they are run."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One row.

    Args:
        number: as `make soak ROW=` takes it.
        module: of this package, with `run(form, tally, folder)`.
        title: what must hold.
        limit_s: after which it counts as lost; with the compiling before the first row, all
            together stay below two hours.
    """

    number: int
    module: str
    title: str
    limit_s: float


ROWS = (
    Row(1, "non_finite", "A non-finite value ends the run, named, and never reaches MuJoCo", 180),
    Row(2, "diverged_sweeps", "Divergence is flagged in every row of a sweep", 120),
    Row(3, "actuator_safety", "No command passes the limits; joint limits stop the arm", 120),
    Row(4, "kills", "SIGKILL at any instant costs at most 0.1 s", 600),
    Row(5, "torn_logs", "Torn and flipped logs give a prefix or one error", 300),
    Row(6, "write_errors", "A full disk or a failing write leaves a readable log", 300),
    Row(7, "fuzzing", "Fuzzed input gives typed errors only, in bounded time and memory", 1080),
    Row(
        8, "hostile_files", "Hostile files are refused by name, and nothing outside is touched", 240
    ),
    Row(9, "servers", "Servers bind 127.0.0.1 unless told otherwise, and say so when told", 180),
    Row(10, "determinism", "The same scenario gives the same bytes, however it is run", 480),
    Row(11, "long_runs", "An hour, and ten thousand runs, in flat memory", 600),
    Row(12, "overload", "Overload in real time is counted, guarded and got over", 300),
    Row(13, "concurrency", "Two writers of one name never mix", 240),
    Row(14, "supply_chain", "What is installed is known, licensed and built clean", 1160),
    Row(15, "mutation", "Broken mathematics fails a test", 1000),
)


def row_of(number: int) -> Row:
    """The row of that number."""
    return next(row for row in ROWS if row.number == number)
