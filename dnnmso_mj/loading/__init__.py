"""Load a scenario: YAML file and `--set` in, a validated Scenario out, or every reason why not."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from dnnmso_mj.dynamics import centre_and_inertia
from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.loading.complaints import Complaint, complain, explain
from dnnmso_mj.loading.documents import Node, Problem, read_document
from dnnmso_mj.loading.overrides import Override, apply_overrides, parse_overrides
from dnnmso_mj.loading.shape import ABSENT, Shape, lookup, scenario_schema
from dnnmso_mj.paths import find_model, find_scenario, model_name, scenarios_dir
from dnnmso_mj.scenario import Plant, Scenario, expand
from dnnmso_mj.wording import clean

__all__ = ["ScenarioWarning", "list_scenarios", "load_scenario", "scenario_schema"]

# ruamel.yaml takes time that grows with the square of a long tag: 1 s for 256 KiB, 13 s for 1 MiB.
MAX_BYTES = 256 * 1024
MAX_LINES = 100


class ScenarioWarning(UserWarning):
    """A scenario that can be run, but that no controller can do well."""


def load_scenario(source: str | Path, overrides: Sequence[str] = ()) -> Scenario:
    """Read, change and check a scenario.

    Args:
        source: a YAML file, or the name of a shipped scenario ("paper").
        overrides: `--set` strings, "plant.gravity=1.62"; see `dnnmso_mj.loading.overrides`.

    Returns:
        The scenario. Its plant.model is a shipped model's name or an absolute path. A relative
        path is taken from the scenario's folder in a file, from the current folder in a `--set`.

    Raises:
        ScenarioError: one line a problem, `FILE:LINE: key.path = VALUE: problem; allowed: ...`,
            sorted by line; the place of an override is `--set a.b=c`.

    Warns:
        ScenarioWarning: a torque limit under the static gravity load.
    """
    sets = parse_overrides(overrides)
    file = find_scenario(source)
    root, problems = read_document(_read(file))
    places = _Places(file, root, sets)
    if root is None or not isinstance(root.value, dict):
        raise ScenarioError(places.message(problems or [_not_a_scenario(root)], []))
    data = root.plain()
    complaints = apply_overrides(data, sets)
    complaints += _resolve_model(data, file, sets)
    scenario = None
    try:
        scenario = Scenario.model_validate(data)
    except ValidationError as error:
        complaints += explain(error, data)
    if scenario is None or complaints or problems:
        raise ScenarioError(places.message(problems, complaints))
    for problem in _overloads(scenario):
        complaint = complain(("imperfections", "torque_limit"), data, problem)
        message = places.message([], [complaint])
        warnings.warn(message, ScenarioWarning, stacklevel=2)
    return scenario


def list_scenarios() -> list[tuple[str, str]]:
    """Name and description of every shipped scenario, by name."""
    files = sorted(scenarios_dir().glob("*.yaml"))
    return [(file.stem, load_scenario(file).description) for file in files]


def stretched_load(plant: Plant) -> np.ndarray:
    """The largest static gravity load, of the arm stretched out level: N·m, shape (n,).

    Joint i carries g Σ_{j≥i} m_j d_ij, with d_ij the distance along the arm from joint i to link
    j's centre of mass. Empty where the model brings its own masses.
    """
    if plant.masses is None or plant.lengths is None:
        return np.zeros(0)
    lengths = np.array(plant.lengths)
    links = zip(plant.masses, plant.lengths, strict=True)
    centres = np.array([centre_and_inertia(plant.links, mass, length)[0] for mass, length in links])
    joints = np.concatenate(([0.0], np.cumsum(lengths)[:-1]))
    arms = (joints + centres)[None, :] - joints[:, None]
    with np.errstate(over="ignore"):
        load: np.ndarray = plant.gravity * np.triu(arms * np.array(plant.masses)).sum(axis=1)
    return load


def _overloads(scenario: Scenario) -> Iterator[str]:
    """What to warn of: each joint whose limit is under its static load."""
    limit = scenario.imperfections.torque_limit
    load = stretched_load(scenario.plant)
    if limit is None or load.size == 0:
        return
    for k, (most, needed) in enumerate(zip(expand(limit, load.size), load, strict=True), start=1):
        if most < needed:
            yield (
                f"joint {k} is limited to {most:.4g} N·m, under the static gravity load of "
                f"{needed:.4g} N·m of the arm stretched out level; no controller can hold it"
            )


def _read(file: Path) -> str:
    name = clean(str(file))
    try:
        with file.open("rb") as stream:
            raw = stream.read(MAX_BYTES + 1)
    except OSError as error:
        raise ScenarioError(f"{name}: cannot be read: {error.strerror}") from error
    if len(raw) > MAX_BYTES:
        raise ScenarioError(f"{name}: too large for a scenario; allowed: {MAX_BYTES} bytes")
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        byte = raw[error.start]
        raise ScenarioError(f"{name}:{line}: byte 0x{byte:02x}; allowed: text in UTF-8") from error


def _not_a_scenario(root: Node | None) -> Problem:
    keys = f"allowed: the keys {', '.join(Shape.root().keys)}"
    if root is None or root.value is None:
        return Problem(1, f"the file is empty; {keys}")
    found = "a list" if isinstance(root.value, list) else "a single value"
    return Problem(root.line, f"the file holds {found}; {keys}")


def _resolve_model(data: Any, file: Path, sets: Sequence[Override]) -> list[Complaint]:
    """Replace plant.model in `data` by what it is found by from any folder."""
    path = ("plant", "model")
    name = lookup(data, path)
    if not isinstance(name, str):
        return []
    base = Path.cwd() if any(item.covers(path) for item in sets) else file.absolute().parent
    try:
        data["plant"]["model"] = model_name(find_model(name, base))
    except ScenarioError as error:
        return [complain(path, data, str(error))]
    return []


class _Places:
    """Where each complaint stands: on a line of the file, or in a `--set`."""

    def __init__(self, file: Path, root: Node | None, sets: Sequence[Override]) -> None:
        self.name = clean(str(file))
        self.root = root or Node(1, None)
        self.data = self.root.plain()
        self.sets = sets

    def message(self, problems: Sequence[Problem], complaints: Sequence[Complaint]) -> str:
        """All of it, sorted by line; what `--set` brought comes last, in its order."""
        lines = [((0, p.line), f"{self.name}:{p.line}", p.text) for p in problems]
        lines += [(*self.of(complaint), complaint.text) for complaint in complaints]
        lines.sort(key=lambda line: line[0])
        texts = [f"{place}: {text}" for _, place, text in lines]
        if len(texts) > MAX_LINES:
            texts[MAX_LINES:] = [f"… and {len(texts) - MAX_LINES} more"]
        return "\n".join(texts)

    def of(self, complaint: Complaint) -> tuple[tuple[int, int], str]:
        """What to sort a complaint by, and its place in words."""
        path = complaint.path
        causes = [item for item in self.sets if item.covers(path)]
        if not causes and complaint.missing:
            causes = [item for item in self.sets if item.covers((*path[:-1], "kind"))]
        if not causes and lookup(self.data, path) is ABSENT:
            causes = [item for item in self.sets if item.enters(path)]
        if causes:
            cause = max(reversed(causes), key=lambda item: len(item.path))
            return (1, self.sets.index(cause)), cause.place
        line = self.root.line_of(path)
        return (0, line), f"{self.name}:{line}"
