"""Load a scenario: YAML file and `--set` in, a validated Scenario out, or every reason why not."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.loading.advice import advice
from dnnmso_mj.loading.complaints import Complaint, complain, explain
from dnnmso_mj.loading.documents import Node, Problem, read_document
from dnnmso_mj.loading.overrides import Override, apply_overrides, parse_overrides
from dnnmso_mj.loading.places import Places
from dnnmso_mj.loading.shape import Shape, lookup, scenario_schema
from dnnmso_mj.paths import find_model, find_scenario, model_name, scenario_names, scenarios_dir
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.wording import clean

__all__ = ["ScenarioWarning", "list_scenarios", "load_scenario", "located", "scenario_schema"]

# ruamel.yaml takes time that grows with the square of a long tag: 1 s for 256 KiB, 13 s for 1 MiB.
MAX_BYTES = 256 * 1024


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
        ScenarioWarning: a torque limit under the static gravity load; gains that no step of dt
            can hold.
    """
    sets = parse_overrides(overrides)
    file = find_scenario(source)
    root, problems = read_document(_read(file))
    places = Places(file, root, sets)
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
    for path, problem in advice(scenario):
        message = places.message([], [complain(path, data, problem)])
        warnings.warn(message, ScenarioWarning, stacklevel=2)
    return scenario


def located(
    error: ScenarioError, source: str | Path, overrides: Sequence[str] = ()
) -> ScenarioError:
    """An error of a model that does not fit its scenario, with the place of the key it names.

    Args:
        error: raised by what was built from the scenario; its text begins with a key path.
        source, overrides: what `load_scenario` made the scenario of.
    """
    sets = parse_overrides(overrides)
    file = find_scenario(source)
    root, _ = read_document(_read(file))
    data = root.plain() if root else {}
    apply_overrides(data, sets)
    named = re.match(r"[a-z]\w*(\.\w+)*", str(error))
    path = tuple(named.group().split(".")) if named else ()
    if not path or Shape.root().at(path, data) is None:
        return error
    complaint = Complaint(path, str(error))
    return ScenarioError(Places(file, root, sets).message([], [complaint]))


def list_scenarios() -> list[tuple[str, str]]:
    """Name and description of every shipped scenario, by name."""
    folder = scenarios_dir()
    return [(n, load_scenario(folder / f"{n}.yaml").description) for n in scenario_names()]


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
