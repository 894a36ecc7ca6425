"""Policies that are a PD law, action = W · observation, in every form that a scenario can name."""

from __future__ import annotations

import textwrap
import warnings
from pathlib import Path

import numpy as np

KP, KD = 574.0, 153.0  # the defaults of `kind: pd`
SCALE = 1024.0  # N·m, a power of two above all torques of these tests

SOURCE = '''
import numpy as np


class PdLaw:
    """action = W · observation."""

    def __init__(self, kp=574.0, kd=153.0, scale=1024.0):
        eye, zero = np.eye(2) / scale, np.zeros((2, 4))
        self.weights = np.hstack([-kp * eye, -kd * eye, kp * eye, kd * eye, zero])

    def __call__(self, observation):
        return self.weights @ observation


class Counter:
    """The action grows by a thousandth a tick; it remembers how far it is."""

    def reset(self):
        self.ticks = 0

    def __call__(self, observation):
        self.ticks = getattr(self, "ticks", 0) + 1
        return np.full(2, 1e-3 * self.ticks)

    def state(self):
        return {"ticks": np.array([getattr(self, "ticks", 0)])}

    def restore(self, state):
        self.ticks = int(state["ticks"][0])


class Secretive:
    """Remembers how often it was called, and does not say so."""

    ticks = 0

    def __call__(self, observation):
        self.ticks += 1
        return np.full(2, 1e-3 * self.ticks)


def sour(observation):
    raise RuntimeError("a policy of no use")


def make_sour():
    return sour


def make_long():
    return lambda observation: np.zeros(3)


def make_late():
    """Not finite once the reference has moved."""
    return lambda observation: np.full(2, 0.0 if observation[5] in {0.0, 1.0} else np.nan)


def nothing():
    return None


class Forgets:
    def __call__(self, observation):
        return np.zeros(2)

    def state(self):
        return {}


not_callable = 3
'''


def weights() -> np.ndarray:
    """W (2, 12)."""
    eye, zero = np.eye(2) / SCALE, np.zeros((2, 4))
    return np.hstack([-KP * eye, -KD * eye, KP * eye, KD * eye, zero])


def write_python(folder: Path) -> Path:
    path = folder / "laws.py"
    path.write_text(textwrap.dedent(SOURCE))
    return path


def write_torchscript(path: Path, W: np.ndarray) -> Path:
    import torch

    linear = torch.nn.Linear(W.shape[1], W.shape[0], bias=False, dtype=torch.float64)
    with torch.no_grad():
        linear.weight.copy_(torch.tensor(W))
    with warnings.catch_warnings(action="ignore"):  # torch would rather have torch.export used
        torch.jit.save(torch.jit.trace(linear, torch.zeros(1, W.shape[1]).double()), str(path))
    return path


def write_onnx(path: Path, W: np.ndarray, shape: tuple[int, ...] = (1, 12)) -> Path:
    import onnx
    from onnx import helper, numpy_helper

    kind = helper.np_dtype_to_tensor_dtype(W.dtype)
    given = helper.make_tensor_value_info("observation", kind, shape)
    action = helper.make_tensor_value_info("action", kind, (*shape[:-1], len(W)))
    node = helper.make_node("MatMul", ["observation", "W"], ["action"])
    constant = numpy_helper.from_array(np.ascontiguousarray(W.T), "W")
    graph = helper.make_graph([node], "law", [given], [action], [constant])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(model, str(path))
    return path
