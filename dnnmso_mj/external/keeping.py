"""The state of an object from outside: what must be put back for it to go on as it was.

An object with `state()` and `restore(state)` says so itself. Of any other it is its attributes that
are numbers, NumPy arrays, None, texts, and lists, tuples and dicts of these; one whose attributes
are anything else that may change is refused, since nobody could go on from a log of it.
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

PLAIN, RNG = "_plain", "_rng"  # keys of what is kept as JSON,
TUPLE = "_tuple"  # which has no tuples
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
        for name, value in _attributes(self._thing).items():
            if value is self._rng or isinstance(value, _FIXED):
                continue
            if isinstance(value, np.ndarray | np.generic) and not value.dtype.hasobject:
                arrays[name] = np.array(value)
            elif _is_plain(value):
                plain[name] = _written(value)
            else:
                raise ExternalError(
                    f"{self._who} has an attribute {name} of {type(value).__name__}, which no log "
                    "can hold; allowed: numbers, NumPy arrays, texts, lists, tuples and dicts of "
                    "them, setup.rng; or methods state and restore"
                )
        return arrays | {PLAIN: np.array(json.dumps(plain))}

    def _put_back(self, state: dict[str, Array]) -> None:
        for name, value in json.loads(str(state.pop(PLAIN))).items():
            _set(self._thing, name, _read(value))
        for name, values in state.items():
            before = getattr(self._thing, name, None)
            if isinstance(before, np.ndarray) and before.shape == values.shape:
                before[...] = values  # others may look at it
            else:
                _set(self._thing, name, values.copy() if values.ndim else values[()])


_set = object.__setattr__  # of a frozen dataclass too


def _attributes(thing: Any) -> dict[str, Any]:
    """All attributes that an object has of its own, in its dict and in slots."""
    found = object.__getstate__(thing)
    parts = found if isinstance(found, tuple) else (found,)
    return {name: value for part in parts if part for name, value in part.items()}


def _is_plain(value: Any) -> bool:
    """Whether JSON can hold it; what only resembles a list, a tuple or a dict, it cannot."""
    kind = type(value)
    if kind is dict:
        names = all(isinstance(key, str) and key != TUPLE for key in value)
        return names and all(_is_plain(below) for below in value.values())
    if kind in {list, tuple}:
        return all(_is_plain(below) for below in value)
    return value is None or isinstance(value, bool | int | float | str)


def _written(value: Any) -> Any:
    """A plain value for JSON, its tuples as `{TUPLE: [...]}`."""
    if isinstance(value, dict):
        return {key: _written(below) for key, below in value.items()}
    if isinstance(value, list | tuple):
        items = [_written(below) for below in value]
        return {TUPLE: items} if isinstance(value, tuple) else items
    return value


def _read(value: Any) -> Any:
    """What `_written` was given."""
    if isinstance(value, list):
        return [_read(below) for below in value]
    if isinstance(value, dict):
        if TUPLE in value:
            return tuple(map(_read, value[TUPLE]))
        return {key: _read(below) for key, below in value.items()}
    return value
