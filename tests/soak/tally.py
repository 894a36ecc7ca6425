"""What one row of the scorecard tried, and how that ended."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class Form:
    """How much of a row is tried.

    Args:
        long: `make soak`; otherwise the form that the tests run.
        seed: of every random choice in the row.
    """

    long: bool = False
    seed: int = 0

    def pick(self, short: T, long: T) -> T:
        """The size of something in this form."""
        return long if self.long else short


@dataclass
class Tally:
    """Counts of a row; each thing tried survived, was lost, or let in what it had to refuse."""

    survived: int = 0
    lost: list[str] = field(default_factory=list)
    let_in: list[str] = field(default_factory=list)
    not_run: dict[str, str] = field(default_factory=dict)
    figures: dict[str, Any] = field(default_factory=dict)

    @property
    def tried(self) -> int:
        """Everything that was run."""
        return self.survived + len(self.lost) + len(self.let_in)

    @property
    def passed(self) -> bool:
        """Whether all of the row was run, and all of it held."""
        return self.tried > 0 and not (self.lost or self.let_in or self.not_run)

    def survive(self, count: int = 1) -> None:
        """Something held."""
        self.survived += count

    def lose(self, what: str) -> None:
        """Something was not kept that had to be: data, a bound, a promise, the process."""
        self.lost.append(what)

    def admit(self, what: str) -> None:
        """Something was accepted, read or written that had to be refused."""
        self.let_in.append(what)

    def leave_out(self, what: str, why: str) -> None:
        """Something could not be run here; it never counts as passed."""
        self.not_run[what] = why

    def figure(self, name: str, value: Any) -> None:
        """A measured value for the scorecard, as JSON takes it; with its unit in the name."""
        self.figures[name] = value

    @contextmanager
    def case(self, what: str) -> Iterator[None]:
        """One thing tried: lost if an assertion in it fails or anything else is raised."""
        try:
            yield
        except Exception as error:
            first = (str(error) or "failed").strip().splitlines()[0]
            self.lose(f"{what}: {type(error).__name__}: {first}")
        else:
            self.survive()
