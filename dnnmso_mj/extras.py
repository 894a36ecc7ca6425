"""Optional parts of the package: what each is for, what it imports, and how to get it."""

from __future__ import annotations

from importlib.util import find_spec
from typing import NamedTuple

from dnnmso_mj.errors import MissingExtraError


class Extra(NamedTuple):
    """An extra of the package.

    Args:
        use: what cannot be done without it.
        modules: what it imports, by the distribution that brings each.
    """

    use: str
    modules: dict[str, str]

    @property
    def missing(self) -> list[str]:
        """Distributions of it that are not installed; nothing is imported to see that."""
        return [name for name, module in self.modules.items() if find_spec(module) is None]


_PLOT = {"matplotlib": "matplotlib", "pillow": "PIL"}
_SWEEP = {"pyarrow": "pyarrow"}
_TORCH = {"torch": "torch"}
_DM_CONTROL = {"dm-control": "dm_control"}
_ENVIRONMENTS = _DM_CONTROL | {"gymnasium": "gymnasium"}
EXTRAS = {
    "viewer": Extra("seeing the arm: dnnmso replay", {"rerun-sdk": "rerun"}),
    "plot": Extra("figures of dnnmso run, plot and audit", _PLOT),
    "sweep": Extra("tables of dnnmso sweep, compare and margins", _SWEEP),
    "report": Extra("dnnmso report", _PLOT | _SWEEP | {"jinja2": "jinja2"}),
    "tune": Extra("dnnmso tune", _SWEEP | {"optuna": "optuna"}),
    "ray": Extra("dnnmso sweep --engine ray", _SWEEP | {"ray": "ray"}),
    "reference": Extra("controller.network.backend = torch", _TORCH),
    "dm-control": Extra("the model in dm_control's Physics", _DM_CONTROL),
    "environments": Extra("environments of dm_control and Gymnasium", _ENVIRONMENTS),
    "policy": Extra("policies in ONNX files", {"onnxruntime": "onnxruntime"}),
    "bench": Extra(
        "all that dnnmso bench compares with",
        {**_SWEEP, **_TORCH, **_ENVIRONMENTS, "mcap-protobuf-support": "mcap_protobuf"},
    ),
}


def pip_install(extra: str) -> str:
    """The command that brings an extra."""
    return f"pip install 'dnnmso_mj[{extra}]'"


def require(extra: str, what: str) -> None:
    """See to it that an extra is there before work is begun that needs it.

    Args:
        extra: one of `EXTRAS`.
        what: needs it, as a message begins: "dnnmso sweep".

    Raises:
        MissingExtraError: some of it is not installed; names what, and how to get it.
    """
    missing = EXTRAS[extra].missing
    if missing:
        are = "which is" if len(missing) == 1 else "which are"
        raise MissingExtraError(
            f"{what} needs {' and '.join(missing)}, {are} not installed: {pip_install(extra)}"
        )


def extra_of(module: str) -> str | None:
    """The smallest extra that brings a module; None for one of no extra."""
    root = module.partition(".")[0]
    return next((name for name, extra in EXTRAS.items() if root in extra.modules.values()), None)
