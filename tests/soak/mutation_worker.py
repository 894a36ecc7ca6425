"""Runs tests against mutants: a process that imports and collects once, and forks for each mutant.

As a program: mutation_worker.py ORDERS VERDICTS; the first a JSON list, the other JSON lines.

Compiled functions run as the plain Python they are written in, and MuJoCo's functions through
ctypes, for a mutant that had to be compiled would take half a minute. That compiled code does the
same is a test of its own (`test_every_controller.py`). Nothing else is replaced. A mutant's
functions get their new code where they stand, so whoever has imported them runs it.
"""

from __future__ import annotations

import ctypes
import gc
import importlib
import inspect
import json
import os
import resource
import shutil
import signal
import sys
import time
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import hypothesis
import pytest

from dnnmso_mj import compiling

# Run at length, or in other processes, which no mutant reaches.
LEFT_OUT = (
    "test_network.py::test_kernel_learns_as_the_reference",
    "test_network.py::test_single_precision_learns_as_double",
    "test_network.py::test_a_restored_learner",
    "test_optimizers.py::test_kernel_learns_as_torch",
    "test_optimizers.py::test_a_restored_learner",
    "test_optimizers.py::test_each_rule_tracks",
    "test_recording.py::test_sigkill",
    "test_recording.py::test_ctrl_c",
    "test_recording.py::test_rows_reach_the_file_by_themselves[0.1]",
)
F = TypeVar("F", bound=Callable[..., Any])

TESTS = Path(__file__).parents[1]
NO_TESTS = "conftest.py"
KILLED, BROKEN = 1, 3  # exit statuses
MEMORY_BYTES = 2**30  # that a mutant may take beside what is imported
LEAST_S, TIMES = 5.0, 4.0  # time limit: so long, and so many times what the tests take unchanged


class UnfitError(Exception):
    """A mutant's function cannot stand where the original does."""


def plain(function: F) -> F:
    """In the place of the decorators that compile."""
    function.py_func = function  # type: ignore[attr-defined]
    return function


def interpret() -> None:
    """Let everything that is compiled run in the interpreter; before any of it is imported."""
    compiling.compiled = compiling.inner = plain
    for name, value in list(vars(compiling).items()):
        if hasattr(value, "py_func"):
            setattr(compiling, name, plain(value.py_func))
    from numba.core.types import ExternalFunction

    from dnnmso_mj import mujoco_calls

    library = ctypes.CDLL(str(mujoco_calls._LIBRARY))
    for name, value in list(vars(mujoco_calls).items()):
        if isinstance(value, ExternalFunction):
            function = getattr(library, value.symbol)
            function.restype = None
            wide = (ctypes.c_int32, ctypes.c_void_p)
            function.argtypes = [wide[each.bitwidth == 64] for each in value.sig.args]
            setattr(mujoco_calls, name, function)


def mutate(file: str, source: str) -> None:
    """Give the functions of a loaded module, and its constants, what a changed source has."""
    name = "dnnmso_mj." + file.removesuffix(".py").replace("/", ".")
    module = importlib.import_module(name)
    new = {"__name__": name, "__package__": name.rpartition(".")[0], "__file__": module.__file__}
    exec(compile(source, str(module.__file__), "exec", dont_inherit=True), new)
    for key, value in new.items():
        old = vars(module).get(key)
        if key.startswith("__"):
            continue
        if isinstance(value, type) and value.__module__ == name:
            for attribute, member in vars(value).items():
                _transplant(vars(old).get(attribute), member, old)
        elif getattr(value, "__module__", None) == name and callable(value):
            _transplant(old, value)
        elif not isinstance(value, types.ModuleType) and value is not old and value != old:
            vars(module)[key] = value
            for other in list(sys.modules.values()):
                if not isinstance(old, type) and vars(other).get(key, module) is old:
                    setattr(other, key, value)


def _transplant(old: Any, new: Any, owner: type | None = None) -> None:
    """Code and defaults of a function, of what it wraps, or of a property, into the old one.

    A method of `owner` that no longer says `super()` is put in the old one's place.
    """
    if isinstance(new, property):
        old, new = old.fget, new.fget
    old, new = inspect.unwrap(old), inspect.unwrap(new)
    if isinstance(new, types.FunctionType):
        if len(old.__code__.co_freevars) != len(new.__code__.co_freevars):
            if owner is None or new.__code__.co_freevars:
                raise UnfitError(new.__qualname__)
            setattr(owner, new.__name__, new)
            return
        old.__code__, old.__defaults__ = new.__code__, new.__defaults__
        old.__kwdefaults__ = new.__kwdefaults__


class Trial:
    """A pytest plugin: instead of running what was collected, runs it against each mutant.

    Args:
        orders: mutants as (file, source, tests), the tests as beginnings of their names.
        verdicts: the file that each one's is written to, a line of JSON.
        folder: where tests put their files.
    """

    def __init__(
        self, orders: list[tuple[str, str, list[str]]], verdicts: Path, folder: Path
    ) -> None:
        self.orders = orders
        self.verdicts = verdicts
        self.folder = folder
        self.failed = ""

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        usual: dict[tuple[str, ...], float] = {}
        for file, source, tests in self.orders:
            items = [item for test in tests for item in _named(session.items, test)]
            if tuple(tests) not in usual:
                started = time.monotonic()
                _protocol(items)  # imports and caches whatever these tests need
                usual[tuple(tests)] = time.monotonic() - started
                if self.failed:
                    raise pytest.UsageError(f"with nothing changed, {self.failed} failed")
                gc.collect()
                gc.freeze()
            limit = LEAST_S + TIMES * usual[tuple(tests)]
            verdict = _verdict(items, file, source, limit)
            with self.verdicts.open("a") as out:
                out.write(f"{json.dumps(verdict)}\n")
            for made in self.folder.glob("*"):
                shutil.rmtree(made, ignore_errors=True)
        return True

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed and _OUT >= 0:
            _leave(KILLED, report.nodeid)
        elif report.failed:
            self.failed = report.nodeid


def _protocol(items: list[pytest.Item]) -> None:
    for item, following in zip(items, [*items, None][1:], strict=True):
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)


def _named(items: list[pytest.Item], test: str) -> list[pytest.Item]:
    found = [item for item in items if item.nodeid.removeprefix("tests/").startswith(test)]
    if not found:
        raise pytest.UsageError(f"no test is named {test}")
    return found


def _leave(status: int, why: str) -> None:
    os.write(_OUT, why.encode())
    os._exit(status)


_OUT = -1  # of a child: where it says what killed it


def _verdict(items: list[pytest.Item], file: str, source: str, limit: float) -> dict[str, Any]:
    """Outcome of the tests in a forked process, within limits of time and memory."""
    started = time.monotonic()
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        os.close(reading)
        _try(items, file, source, limit, writing)
    os.close(writing)
    with os.fdopen(reading, "rb") as said:
        why = said.read().decode(errors="replace")
    _, status = os.waitpid(child, 0)
    ended = os.waitstatus_to_exitcode(status)
    outcome = {0: "survived", KILLED: "killed", BROKEN: "broken", -signal.SIGALRM: "timed out"}
    return {
        "outcome": outcome.get(ended, "killed"),
        "why": why or f"status {ended}",
        "seconds": time.monotonic() - started,
    }


def _try(items: list[pytest.Item], file: str, source: str, limit: float, out: int) -> None:
    """In the child, which never returns."""
    global _OUT  # noqa: PLW0603
    _OUT = out
    gc.disable()
    os.setpgid(0, 0)  # so that what it does to its group does not reach us
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, limit)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    try:
        if source:
            mutate(file, source)
    except UnfitError as error:
        _leave(BROKEN, str(error))
    except BaseException as error:
        _leave(KILLED, f"import: {error!r}")
    try:
        _protocol(items)
    except BaseException as error:
        _leave(KILLED, repr(error))
    _leave(0, "")


def run(orders: list[tuple[str, str, list[str]]], verdicts: Path) -> None:
    """Write the verdicts of the mutants, in their order."""
    hypothesis.settings.register_profile(
        "mutation",
        derandomize=True,
        database=None,
        deadline=None,
        max_examples=40,
        phases=[hypothesis.Phase.explicit, hypothesis.Phase.generate],
    )
    hypothesis.settings.load_profile("mutation")
    folder = verdicts.parent / "tests"
    files = {test.partition("::")[0] for _, _, tests in orders for test in tests}
    options = ["-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:faulthandler", "--capture=no"]
    options += [f"--rootdir={TESTS.parent}", f"--basetemp={folder}"]
    options += [f"--deselect=tests/{name}" for name in LEFT_OUT]
    options += [str(TESTS / file) for file in sorted(files or {NO_TESTS})]
    pytest.main(options, plugins=[Trial(orders, verdicts, folder)])


def main() -> None:
    os.environ["DNNMSO_SKIP_WARM_UP"] = "1"
    interpret()
    orders, verdicts = map(Path, sys.argv[1:])
    run(json.loads(orders.read_text()), verdicts)


if __name__ == "__main__":
    main()
