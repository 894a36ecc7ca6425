"""How this package compiles: the decorators of everything that runs without the interpreter."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import Any, Literal, TypeVar, cast

import numpy as np
from numba import config, njit
from numba.core import event

from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.sources import sources_digest

Array = np.ndarray
F = TypeVar("F", bound=Callable[..., Any])


# Of every source that is compiled, since each is compiled into its callers.
_SOURCES = sources_digest(b"@compiled", b"@inner", b"ExternalFunction")

# No counting of references, which took a quarter of a small tick. numba's types do not list it.
_UNCOUNTED: dict[str, Any] = {"_nrt": False}


def compiled(function: F) -> F:
    """Compile a function when it is first called, and keep it on disk for later processes.

    A tick allocates nothing: a function that would, or that returns a view, fails to compile.
    """
    return _compile(function, "never")


def inner(function: F) -> F:
    """The same for small parts of a tick, put in place in their callers.

    A call that passes dozens of arrays takes longer to compile, and to do, than what it is for.
    """
    return _compile(function, "always")


def _compile(function: F, inline: Literal["always", "never"]) -> F:
    if getattr(config, "DISABLE_JIT", 0):
        raise DnnmsoError("NUMBA_DISABLE_JIT is set, and the loop only runs compiled; unset it")
    dispatcher: Any = njit(
        cache=True,
        nogil=True,
        inline=inline,
        error_model="numpy",
        **_UNCOUNTED,
        # Reassociation lets sums vectorise; NaN and infinity keep their meaning, to be caught.
        fastmath={"reassoc", "contract", "arcp", "nsz"},
    )(function)
    # numba looks at the function's own file alone to see whether code on disk is stale, and fails
    # on an index that names a class which is no more: code of other sources has other files.
    own = dispatcher._cache._cache_file
    base = own._index_name.removesuffix(".nbi")
    dispatcher._cache._cache_file = type(own)(
        own._cache_path, f"{base}-{_SOURCES[:16]}", own._source_stamp
    )
    return cast(F, dispatcher)


@compiled
def copy(values: Array, out: Array) -> None:
    """The first len(values) of `out` become `values`; a slice would compile its error message."""
    for i in range(values.size):
        out[i] = values[i]


@compiled
def is_finite(values: Array) -> bool:
    """Whether every one of some values is finite."""
    bad = 0
    for value in values:
        bad += not math.isfinite(value)  # without a branch, so that it vectorises
    return bad == 0


class CompileNotice(event.Listener):
    """Says once, on standard error, why the first run of all takes seconds longer."""

    def __init__(self) -> None:
        self._said = False

    def on_start(self, event: event.Event) -> None:
        if not self._said:
            self._said = True
            print("compiling the control loop; later runs load it", file=sys.stderr, flush=True)

    def on_end(self, event: event.Event) -> None:
        pass
