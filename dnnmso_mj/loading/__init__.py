"""Load a scenario: YAML file and `--set` in, a validated Scenario out, or every reason why not."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.loading.advice import advice
from dnnmso_mj.loading.complaints import Complaint, complain, explain
from dnnmso_mj.loading.documents import Node, Problem, read_document
from dnnmso_mj.loading.overrides import apply_overrides, parse_overrides
from dnnmso_mj.loading.pinning import pin_policy
from dnnmso_mj.loading.places import Places
from dnnmso_mj.loading.reach import in_reach, out_of_reach, refused
from dnnmso_mj.loading.shape import Shape, lookup, scenario_schema
from dnnmso_mj.loading.text import read_text
from dnnmso_mj.loading.trust import PROBLEM, anchored, import_paths, require_trust
from dnnmso_mj.loading.tuned import CONTROLLER, Graft, graft_file, graft_sets
from dnnmso_mj.paths import (
    find_controller,
    find_model,
    find_scenario,
    model_name,
    scenario_names,
    scenarios_dir,
    shipped_controllers,
)
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.scenario.tuned import TunedController
from dnnmso_mj.wording import did_you_mean, show

__all__ = [
    "ScenarioWarning",
    "controller_kinds",
    "controller_set",
    "kind_set",
    "list_scenarios",
    "load_scenario",
    "located",
    "require_trust",
    "scenario_schema",
]


class ScenarioWarning(UserWarning):
    """A scenario that can be run, but that no controller can do well."""


def load_scenario(
    source: str | Path,
    overrides: Sequence[str] = (),
    controller: str | None = None,
    *,
    trust: bool = False,
) -> Scenario:
    """Read, change and check a scenario.

    Args:
        source: a YAML file, or the name of a shipped scenario ("paper").
        overrides: `--set` strings, "plant.gravity=1.62"; see `dnnmso_mj.loading.overrides`.
        controller: what replaces the scenario's own controller, before `overrides` change it: a
            shipped tuned controller, a kind with its defaults, or a file.
        trust: whether it may name code by import path, which a run of it then runs, and files
            that are out of reach (`dnnmso_mj.loading.reach`); nothing is imported here.

    Returns:
        The scenario. Its plant.model is a name that is found from anywhere, or an absolute path; so
        is code of its own. A relative path is taken from the folder of the file that it stands in,
        from the current folder in a `--set`.
        `controller: {from: NAME}` is replaced by what NAME holds; see `dnnmso_mj.loading.tuned`.

    Raises:
        ScenarioError: one line a problem, `FILE:LINE: key.path = VALUE: problem; allowed: ...`,
            sorted by line; the place of an override is `--set a.b=c`.

    Warns:
        ScenarioWarning: a torque limit under the static gravity load; gains that no step of dt
            can hold.
    """
    if controller is not None:
        overrides = [controller_set(controller), *overrides]
    draft = _draft(source, overrides, trust)
    data, places, complaints = draft.data, draft.places, draft.complaints
    complaints += _resolve_model(data, places, trust)
    if not trust:
        complaints += [complain(path, data, PROBLEM) for path, _ in import_paths(data)]
        complaints += out_of_reach(data, places)
    if not complaints:
        pin_policy(data)
    scenario = None
    try:
        scenario = Scenario.model_validate(data)
    except ValidationError as error:
        lost = draft.controller_lost  # that alone is said of it
        complaints += [c for c in explain(error, data) if not lost or c.path[:1] != CONTROLLER]
    if scenario is None or complaints or draft.problems:
        raise ScenarioError(places.message(draft.problems, complaints))
    for path, problem in advice(scenario):
        message = places.message([], [complain(path, data, problem)])
        warnings.warn(message, ScenarioWarning, stacklevel=2)
    return scenario


def controller_set(name: str) -> str:
    """The `--set` that puts a controller in a scenario's place.

    Args:
        name: of a shipped tuned controller, a kind (its defaults), or a file; the first that fits.

    Raises:
        ScenarioError: none of them.
    """
    kinds, shipped = controller_kinds(), shipped_controllers()
    if name in kinds and name not in shipped:
        return kind_set(name)
    try:
        find_controller(name, Path.cwd())
    except ScenarioError as error:
        ways = [
            f"a shipped one: {', '.join(shipped)}",
            f"a kind with its defaults: {', '.join(kinds)}",
            "or a YAML file",
        ]
        hint = did_you_mean(name, [*shipped, *kinds])
        problem = f"no controller {show(name)}; allowed: {'; '.join(ways)}{hint}"
        raise ScenarioError(problem) from error
    return f"controller.from={json.dumps(name)}"


def kind_set(kind: str) -> str:
    """The `--set` that puts a kind of controller with its defaults in a scenario's place."""
    return f"controller={{kind: {kind}}}"


@cache
def controller_kinds() -> tuple[str, ...]:
    """Every kind of controller that its defaults alone make whole; a policy needs a file, say."""
    controller = Shape.root().child("controller")
    return tuple(filter(_stands_alone, controller.choices)) if controller else ()


def _stands_alone(kind: str) -> bool:
    try:
        TunedController.model_validate({"controller": {"kind": kind}})
    except ValidationError:
        return False
    return True


def located(
    error: ScenarioError, source: str | Path, overrides: Sequence[str] = ()
) -> ScenarioError:
    """An error of a model that does not fit its scenario, with the place of the key it names.

    Args:
        error: raised by what was built from the scenario; its text begins with a key path.
        source, overrides: what `load_scenario` made the scenario of.
    """
    draft = _draft(source, overrides, trust=True)
    named = re.match(r"[a-z]\w*(\.\w+)*", str(error))
    path = tuple(named.group().split(".")) if named else ()
    if not path or Shape.root().at(path, draft.data) is None:
        return error
    return ScenarioError(draft.places.message([], [Complaint(path, str(error))]))


def list_scenarios() -> list[tuple[str, str]]:
    """Name and description of every shipped scenario, by name."""
    folder = scenarios_dir()
    return [(n, load_scenario(folder / f"{n}.yaml").description) for n in scenario_names()]


@dataclass(frozen=True)
class _Draft:
    """A scenario before it is checked: its data, overridden, and what is wrong with it so far."""

    data: dict[str, Any]
    places: Places
    problems: list[Problem]
    complaints: list[Complaint]
    controller_lost: bool


def _draft(source: str | Path, overrides: Sequence[str], trust: bool) -> _Draft:
    sets = parse_overrides(overrides)
    file = find_scenario(source)
    root, problems = read_document(read_text(file))
    if root is None or not isinstance(root.value, dict):
        problems = problems or [_not_a_scenario(root)]
        raise ScenarioError(Places(file, root, sets).message(problems, []))
    sets, brought, complaints = graft_sets(sets)
    data = anchored(root.plain(), file.absolute().parent)
    grafts: list[Graft] = []
    if not any(item.path == CONTROLLER for item in sets):
        grafts, more = graft_file(data, file.absolute().parent, trust)
        complaints += more
    lost = bool(complaints)
    complaints += apply_overrides(data, sets)
    places = Places(file, root, sets, [*grafts, *brought])
    return _Draft(data, places, problems, complaints, lost)


def _not_a_scenario(root: Node | None) -> Problem:
    keys = f"allowed: the keys {', '.join(Shape.root().keys)}"
    if root is None or root.value is None:
        return Problem(1, f"the file is empty; {keys}")
    found = "a list" if isinstance(root.value, list) else "a single value"
    return Problem(root.line, f"the file holds {found}; {keys}")


def _resolve_model(data: Any, places: Places, trust: bool) -> list[Complaint]:
    """Replace plant.model in `data` by what it is found by from any folder."""
    path = ("plant", "model")
    name = lookup(data, path)
    if not isinstance(name, str):
        return []
    home = places.home(path)
    try:
        file = find_model(name, home or Path.cwd())
    except ScenarioError as error:
        return [complain(path, data, str(error))]
    found = model_name(file, name)
    if found == str(file) and home is not None and not trust and not in_reach(file, home):
        return [refused(path, data, home)]
    data["plant"]["model"] = found
    return []
