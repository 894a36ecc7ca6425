"""A MuJoCo testbed for the online-learning deep neuro-adaptive dynamic inversion controller.

What most people need is here; each name is imported when it is first used.

Examples:
    >>> from dnnmso_mj import load_scenario, simulate
    >>> trace = simulate(load_scenario("paper", ["duration=0.1"], controller="pd"))
    >>> trace["q"].shape
    (100, 2)
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dnnmso_mj.comparison.plan import plan_comparison
    from dnnmso_mj.controllers import Command, Controller, Inputs
    from dnnmso_mj.errors import DnnmsoError
    from dnnmso_mj.external import Setup
    from dnnmso_mj.loading import list_scenarios, load_scenario
    from dnnmso_mj.reading import read_snapshots, read_trace
    from dnnmso_mj.run import run_logged
    from dnnmso_mj.scenario import Scenario
    from dnnmso_mj.simulation import simulate
    from dnnmso_mj.sweep.plan import plan_sweep
    from dnnmso_mj.sweep.run import run_sweep
    from dnnmso_mj.trace import Trace

    __version__: str

__all__ = [
    "Command",
    "Controller",
    "DnnmsoError",
    "Inputs",
    "Scenario",
    "Setup",
    "Trace",
    "__version__",
    "list_scenarios",
    "load_scenario",
    "plan_comparison",
    "plan_sweep",
    "read_snapshots",
    "read_trace",
    "run_logged",
    "run_sweep",
    "simulate",
]

_HOMES = {
    "Command": "controllers",
    "Controller": "controllers",
    "DnnmsoError": "errors",
    "Inputs": "controllers",
    "Scenario": "scenario",
    "Setup": "external",
    "Trace": "trace",
    "list_scenarios": "loading",
    "load_scenario": "loading",
    "plan_comparison": "comparison.plan",
    "plan_sweep": "sweep.plan",
    "read_snapshots": "reading",
    "read_trace": "reading",
    "run_logged": "run",
    "run_sweep": "sweep.run",
    "simulate": "simulation",
}


def __getattr__(name: str) -> Any:
    found: Any
    if name == "__version__":
        from importlib.metadata import version

        found = version(__name__)
    elif name in _HOMES:
        found = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
