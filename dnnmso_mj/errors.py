"""The errors that reach a person: each names the culprit, its value and what is allowed."""


class DnnmsoError(Exception):
    """Root of every error this package raises on purpose. The command line exits with status 2."""


class ScenarioError(DnnmsoError):
    """A scenario, an override or a model that cannot be accepted."""


class LogError(DnnmsoError):
    """A log that cannot be written or read."""


class MissingExtraError(DnnmsoError):
    """An optional part of the package that is not installed."""


class NonFiniteError(DnnmsoError):
    """A quantity that left the finite range, or grew past every plausible value, during a run."""

    def __init__(self, quantity: str, value: object) -> None:
        super().__init__(f"{quantity} = {value}")
        self.quantity = quantity
        self.value = value
