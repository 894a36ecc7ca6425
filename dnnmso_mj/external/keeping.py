"""The state of an object from outside: what must be put back for it to go on as it was.

An object with `state()` and `restore(state)` says so itself. Of any other it is its attributes that
are numbers, NumPy arrays, None, texts, and lists and dicts of these; one whose attributes are
anything that may change is refused, since nobody could go on from a log of it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

from dnnmso_mj.errors import ExternalError
from dnnmso_mj.external import Setup, called
from dnnmso_mj.plant import NominalModel

Array = np.ndarray

PLAIN, RNG = "_plain", "_rng"  # keys of what is kept as JSON
_FIXED = (FunctionType, BuiltinFunctionType, MethodType, ModuleType, type, Setup, NominalModel)


class Kept:
    """Takes and puts back the state of an object.

    Args:
        thing: the object.
        setup: what it was made with, whose random numbers are a part of its state.
        who: it, for messages.

    Raises:
        ExternalError: its state cannot be taken.
    """

    def __init__(self, thing: Any, setup: Setup, who: str) -> None:
        self._thing, self._rng, self._who = thing, setup.rng, who
        own = [name for name in ("state", "restore") if callable(getattr(thing, name, None))]
        if len(own) == 1:
            raise ExternalError(f"{who} has {own[0]} alone; allowed: state and restore, or neither")
        self._own = bool(own)
        self.state()

    def state(self) -> dict[str, Array]:
        """A copy of all that what it does next depends on.

        Raises:
            ExternalError: it cannot be taken.
        """
        with called(f"{self._who}.state"):
            state = self._told() if self._own else self._found()
        return state | {RNG: np.array(json.dumps(self._rng.bit_generator.state))}

    def restore(self, state: Mapping[str, Array]) -> None:
        """Put a `state` back.

        Raises:
            ExternalError: it does not fit.
        """
        rest = dict(state)
        self._rng.bit_generator.state = json.loads(str(rest.pop(RNG)))
        with called(f"{self._who}.restore"):
            if self._own:
                self._thing.restore(rest)
            else:
                self._put_back(rest)

    def _told(self) -> dict[str, Array]:
        told: Any = self._thing.state()
        arrays = {str(name): np.array(values) for name, values in told.items()}
        for name, array in arrays.items():
            if array.dtype.hasobject:
                raise ExternalError(
                    f"{self._who}.state gives {name} of {array.dtype}; allowed: numbers and texts"
                )
        return arrays

    def _found(self) -> dict[str, Array]:
        arrays: dict[str, Array] = {}
        plain: dict[str, Any] = {}
        for name, value in getattr(self._thing, "__dict__", {}).items():
            if value is self._rng or isinstance(value, _FIXED):
                continue
            if isinstance(value, np.ndarray | np.generic) and not value.dtype.hasobject:
                arrays[name] = np.array(value)
            elif _is_plain(value):
                plain[name] = value
            else:
                raise ExternalError(
                    f"{self._who} has an attribute {name} of {type(value).__name__}, which no log "
                    "can hold; allowed: numbers, NumPy arrays, texts, lists and dicts of them, "
                    "setup.rng; or methods state and restore"
                )
        return arrays | {PLAIN: np.array(json.dumps(plain))}

    def _put_back(self, state: dict[str, Array]) -> None:
        for name, value in json.loads(str(state.pop(PLAIN))).items():
            before = getattr(self._thing, name, None)
            setattr(self._thing, name, tuple(value) if isinstance(before, tuple) else value)
        for name, values in state.items():
            before = getattr(self._thing, name, None)
            if isinstance(before, np.ndarray) and before.shape == values.shape:
                before[...] = values  # others may look at it
            else:
                setattr(self._thing, name, values.copy() if values.ndim else values[()])


def _is_plain(value: Any) -> bool:
    """Whether JSON gives back what it was given."""
    if isinstance(value, dict):
        return all(isinstance(key, str) and _is_plain(below) for key, below in value.items())
    if isinstance(value, list | tuple):
        return all(_is_plain(below) for below in value)
    return value is None or isinstance(value, bool | int | float | str)
