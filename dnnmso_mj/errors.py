"""The errors that reach a person: each names the culprit, its value and what is allowed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dnnmso_mj.trace import Trace


class DnnmsoError(Exception):
    """Root of every error this package raises on purpose. The command line exits with status 2."""


class ScenarioError(DnnmsoError):
    """A scenario, an override or a model that cannot be accepted."""


class LogError(DnnmsoError):
    """A log that cannot be written or read."""


class MissingExtraError(DnnmsoError):
    """An optional part of the package that is not installed."""


class ExternalError(DnnmsoError):
    """Code from outside this package that fails, or gives what it may not."""


class RunInterrupted(KeyboardInterrupt):
    """Ctrl-C during a logged run; the log is whole and holds the run's first `ticks`: `trace`."""

    def __init__(self, log: Path, ticks: int, trace: Trace | None = None) -> None:
        super().__init__(f"log: {log} ({ticks} ticks)")
        self.log = log
        self.ticks = ticks
        self.trace = trace


class UnloggedRunError(LogError):
    """A run that ended because its log could not be written; `trace` holds what the log does."""

    def __init__(self, why: str, log: Path, trace: Trace) -> None:
        super().__init__(why)
        self.log = log
        self.trace = trace


class NonFiniteError(DnnmsoError):
    """A quantity that left the finite range, or grew past every plausible value, during a run."""

    def __init__(self, quantity: str, value: object) -> None:
        super().__init__(f"{quantity} = {value}")
        self.quantity = quantity
        self.value = value
