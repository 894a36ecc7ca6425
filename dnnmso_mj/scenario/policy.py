"""A policy from outside the package, trained elsewhere or written by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from dnnmso_mj.scenario.external import Python, Settings
from dnnmso_mj.scenario.fields import Positive, PositiveEach, Strict, refusal

TORCHSCRIPT = (".pt", ".ts")
ONNX = (".onnx",)


class Policy(Strict):
    """A policy: observation (6n,) in, action (n,) within ±1 out; see docs/environments.md."""

    kind: Literal["policy"]
    """A policy from a file, or a Python class."""
    file: str | None = None
    """TorchScript (.pt, .ts) or ONNX (.onnx), relative to the file that names it."""
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None
    """SHA-256 of that file, filled in when the scenario is loaded; another file is refused."""
    python: Python | None = None
    """module:Name or file.py:Name of a class or function, or an entry point of dnnmso_mj.policies;
    called with `settings`, it gives what is called with an observation and gives an action."""
    settings: Settings = Field(default_factory=dict)
    """Keyword arguments for `python`."""
    control_timestep: Positive | None = None
    """How long an action is held (s), a multiple of dt; null: dt."""
    torque_scale: PositiveEach | None = None
    """Torque of action 1 (N·m), each; null: imperfections.torque_limit, or 128 without one."""

    @model_validator(mode="after")
    def _one_source(self) -> Policy:
        if self.file is None and self.python is None:
            raise refusal(("file", "is missing, and python too; allowed: exactly one of them"))
        if self.file is not None and self.python is not None:
            raise refusal(("python", "stands beside file; allowed: exactly one of them"))
        if self.file is not None and Path(self.file).suffix not in (*TORCHSCRIPT, *ONNX):
            known = ", ".join((*TORCHSCRIPT, *ONNX))
            raise refusal(
                ("file", f"is no known kind of file; allowed: a name that ends in {known}")
            )
        if self.file is not None and self.settings:
            raise refusal(("settings", "are for python; allowed: none beside file"))
        if self.file is None and self.sha256 is not None:
            raise refusal(("sha256", "is of a file; allowed: null beside python"))
        return self
