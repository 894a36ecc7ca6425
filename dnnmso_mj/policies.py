"""Policies from outside as functions of an observation: TorchScript, ONNX and Python."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from dnnmso_mj.errors import MissingExtraError, ScenarioError
from dnnmso_mj.external import called, import_callable, told
from dnnmso_mj.scenario.policy import ONNX, Policy
from dnnmso_mj.wording import clean, show

Array = np.ndarray
Act = Callable[[Array], Any]

MAX_BYTES = 256 * 1024 * 1024  # of a file
GROUP = "dnnmso_mj.policies"  # of entry points
FLOATS = {"tensor(float)": np.float32, "tensor(double)": np.float64}


class LoadedPolicy:
    """A policy ready to be called, checked by one call with an observation of zeros.

    Args:
        spec: what the scenario names.
        n_inputs, n_outputs: lengths of the observation and of the action.

    Raises:
        ScenarioError: there is no such policy, or it does not take or give what it should.
        MissingExtraError: what runs such files is not installed.
    """

    def __init__(self, spec: Policy, n_inputs: int, n_outputs: int) -> None:
        self.n_outputs = n_outputs
        self._owner: Any = None  # of what a Python policy remembers
        zeros = np.zeros(n_inputs)
        if spec.file is not None:
            self.name = f"controller.file = {show(spec.file)}"
            load = _onnx if Path(spec.file).suffix in ONNX else _torchscript
            self._act = load(_read(spec, self.name), self.name, zeros, n_outputs)
        else:
            self.name = f"controller.python = {show(spec.python)}"
            self._act = self._owner = _python(spec, self.name)
        remembered = self.state()
        self(zeros)
        self.restore(remembered)

    def __call__(self, observation: Array) -> Array:
        """The action (n,) of an observation (k,).

        Raises:
            ExternalError: the policy fails.
            ScenarioError: it gives something else.
        """
        with called(f"{self.name}: an observation of shape ({observation.size},)"):
            action = np.asarray(self._act(observation), dtype=float)
        if action.shape != (self.n_outputs,):
            raise ScenarioError(
                f"{self.name}: gives an action of shape {action.shape}; allowed: "
                f"({self.n_outputs},), one for each joint"
            )
        return action

    def reset(self) -> None:
        """Tell a policy that has `reset` that a run begins."""
        if hasattr(self._owner, "reset"):
            self._owner.reset()

    def state(self) -> dict[str, Array]:
        """What the policy remembers, if it has `state`."""
        return dict(self._owner.state()) if hasattr(self._owner, "state") else {}

    def restore(self, state: Mapping[str, Array]) -> None:
        """Have the policy remember that again."""
        if hasattr(self._owner, "state"):
            self._owner.restore(state)


def _read(spec: Policy, name: str) -> bytes:
    """The file, which is the one that was meant; nothing is opened after it."""
    path = Path(spec.file or "")
    try:
        if path.exists() and not path.is_file():
            raise ValueError("not a regular file")
        with path.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        what = getattr(error, "strerror", None) or str(error)
        raise ScenarioError(
            f"{name}: {what}; allowed: a file of TorchScript (.pt, .ts) or ONNX (.onnx)"
        ) from error
    if len(data) > MAX_BYTES:
        raise ScenarioError(f"{name}: too large; allowed: {MAX_BYTES} bytes")
    found = sha256(data).hexdigest()
    if spec.sha256 not in {None, found}:
        raise ScenarioError(
            f"controller.sha256 = {show(spec.sha256)}: {clean(str(path))} has {found}; allowed: "
            "the file that was meant, or null"
        )
    return data


def _python(spec: Policy, name: str) -> Act:
    made = import_callable(spec.python or "", "controller.python", GROUP)
    settings = f" with settings {show(spec.settings)}" if spec.settings else " without settings"
    try:
        policy = made(**spec.settings)
    except Exception as error:  # whatever foreign code raises
        raise ScenarioError(f"{name}: cannot be called{settings}: {told(error)}") from error
    if not callable(policy):
        raise ScenarioError(
            f"{name}: called{settings} it gives a {type(policy).__name__}; allowed: what can be "
            "called with an observation"
        )
    if hasattr(policy, "state") != hasattr(policy, "restore"):
        raise ScenarioError(f"{name}: has state or restore alone; allowed: both, or none")
    return policy  # type: ignore[no-any-return]


def _torchscript(data: bytes, name: str, zeros: Array, n_outputs: int) -> Act:
    try:
        import torch
    except ImportError as error:
        raise MissingExtraError(
            f"{name} needs torch, which is not installed; pip install 'dnnmso_mj[reference]', or "
            "export the policy to ONNX"
        ) from error
    torch.set_num_threads(1)  # a policy is small, and a sweep has a process on every core
    try:
        with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
            module = torch.jit.load(BytesIO(data), map_location="cpu")  # type: ignore[no-untyped-call]
    except (
        Exception
    ) as error:  # torch raises RuntimeError, and others for files that are no archive
        raise ScenarioError(
            f"{name}: torch cannot read it: {_first_line(error)}; allowed: a file of torch.jit.save"
        ) from error
    module.eval()
    numbers = [
        value for value in (*module.parameters(), *module.buffers()) if value.is_floating_point()
    ]
    dtype = numbers[0].dtype if numbers else torch.float64

    def run(observation: Array, batch: bool) -> Array:
        with torch.inference_mode():
            given = torch.tensor(observation, dtype=dtype)
            action: Array = module(given[None] if batch else given).numpy()
        return action[0] if batch and action.ndim == 2 and len(action) == 1 else action

    try:
        batch = np.shape(run(zeros, True)) == (n_outputs,)
    except Exception:  # it may want the vector alone; if not, the check says why
        batch = False
    return lambda observation: run(observation, batch)


def _onnx(data: bytes, name: str, zeros: Array, n_outputs: int) -> Act:
    try:
        import onnxruntime
    except ImportError as error:
        raise MissingExtraError(
            f"{name} needs onnxruntime, which is not installed; pip install 'dnnmso_mj[policy]'"
        ) from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # its errors are told as ours
    try:
        # Of bytes, so that weights in files beside it are refused: they could be any file.
        session = onnxruntime.InferenceSession(data, options, ["CPUExecutionProvider"])
    except Exception as error:  # of its own making, each derived from Exception alone
        raise ScenarioError(
            f"{name}: onnxruntime cannot read it: {_first_line(error)}; allowed: an ONNX model, "
            "its weights in it"
        ) from error
    inputs = session.get_inputs()
    shape = inputs[0].shape if inputs else []
    if len(inputs) != 1 or inputs[0].type not in FLOATS or len(shape) not in {1, 2}:
        found = ", ".join(f"{each.name}: {each.type} {each.shape}" for each in inputs) or "nothing"
        raise ScenarioError(
            f"{name}: takes {clean(found)}; allowed: one tensor of floats or doubles, "
            f"[{zeros.size}] or [1, {zeros.size}]"
        )
    key, dtype, batch = inputs[0].name, FLOATS[inputs[0].type], len(shape) == 2

    def run(observation: Array) -> Array:
        given = observation.astype(dtype)
        action: Array = session.run(None, {key: given[None] if batch else given})[0]
        return action[0] if batch and action.ndim == 2 and len(action) == 1 else action

    return run


def _first_line(error: Exception) -> str:
    lines = clean(str(error).strip().split("\n")[0])
    return f"{type(error).__name__}: {lines[:300]}"
