"""The errors that reach a person: each names the culprit, its value and what is allowed."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dnnmso_mj.logged import LoggedRun


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
    """Ctrl-C during a logged run; the log is whole and holds what was `run`."""

    def __init__(self, run: LoggedRun) -> None:
        super().__init__(f"log: {run.log} ({run.ticks} ticks)")
        self.run = run
        self.log = run.log
        self.ticks = run.ticks


class UnloggedRunError(LogError):
    """A run that ended because its log could not be written; `run` holds what the log does."""

    def __init__(self, why: str, run: LoggedRun) -> None:
        super().__init__(why)
        self.run = run


class EndedEarlyError(DnnmsoError):
    """What ends a run before its time; the run says so in its status, and its log is whole."""


class SafeStopError(EndedEarlyError):
    """A joint that was past a limit of the scenario: the arm was stopped."""


class NonFiniteError(EndedEarlyError):
    """A quantity that left the finite range, or grew past every plausible value, during a run."""

    def __init__(self, quantity: str, value: object) -> None:
        super().__init__(f"{quantity} = {value}")
        self.quantity = quantity
        self.value = value
