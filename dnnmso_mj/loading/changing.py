"""Change the scenario of a run that has begun: `--set` on what a log says, checked as if loaded."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.loading.complaints import Complaint, complain, explain
from dnnmso_mj.loading.overrides import Override, apply_overrides, parse_overrides
from dnnmso_mj.loading.pinning import pin_policy
from dnnmso_mj.loading.places import Places
from dnnmso_mj.loading.reach import out_of_reach
from dnnmso_mj.loading.shape import lookup
from dnnmso_mj.loading.trust import PROBLEM, import_paths, require_trust
from dnnmso_mj.loading.tuned import graft_sets
from dnnmso_mj.paths import find_model, model_name
from dnnmso_mj.scenario import Scenario

MODEL = ("plant", "model")
POLICY_FILE = ("controller", "file")
# What a run that has begun cannot have otherwise, and why.
SETTLED = {
    "dt": "the ticks before have another; allowed: what they have",
    "initial": "the run has begun; allowed: what acts from now on",
}


def change_scenario(
    scenario: Scenario, overrides: Sequence[str], source: Path, *, trust: bool = False
) -> Scenario:
    """A scenario with some keys changed.

    Args:
        scenario: of a log.
        overrides: `--set` strings, as `load_scenario` takes them. Relative paths in them begin in
            the current folder.
        source: the log, for messages.
        trust: whether both may name code by import path, and files that are out of reach.

    Raises:
        ScenarioError: one line a problem; an override is malformed, changes what a run that has
            begun cannot change, or makes a scenario that could not be loaded.
    """
    if not trust:
        require_trust(scenario, f"{source}, its scenario")
    sets, grafts, complaints = graft_sets(parse_overrides(overrides))
    places = Places(source, None, sets, grafts)
    data = scenario.model_dump(mode="json")
    settled = deepcopy({key: data[key] for key in SETTLED})
    complaints += apply_overrides(data, sets)
    begun = [
        complain((key,), data, why) for key, why in SETTLED.items() if data[key] != settled[key]
    ]
    complaints += begun or _resolve_model(data, sets)
    if not trust:
        complaints += [complain(path, data, PROBLEM) for path, _ in import_paths(data)]
        complaints += out_of_reach(data, places)
    if not complaints:
        _pin(data, sets)
    try:
        changed = Scenario.model_validate(data)
    except ValidationError as error:
        complaints += [] if begun else explain(error, data)
    if complaints:
        raise ScenarioError("\n".join(f"{_place(places, c)}: {c.text}" for c in complaints))
    return changed


def _resolve_model(data: dict[str, Any], sets: Sequence[Override]) -> list[Complaint]:
    """Replace a plant.model that was set by what it is found by from any folder."""
    name = lookup(data, MODEL)
    if not isinstance(name, str) or not any(item.covers(MODEL) for item in sets):
        return []
    try:
        data["plant"]["model"] = model_name(find_model(name), name)
    except ScenarioError as error:
        return [complain(MODEL, data, str(error))]
    return []


def _pin(data: dict[str, Any], sets: Sequence[Override]) -> None:
    """Another policy file has another checksum."""
    if any(item.path == POLICY_FILE for item in sets) and isinstance(data["controller"], dict):
        data["controller"].pop("sha256", None)
    pin_policy(data)


def _place(places: Places, complaint: Complaint) -> str:
    """The override, or the log: what it says has no lines."""
    (by_override, _), place = places.of(complaint)
    return place if by_override else f"{places.name}, its scenario"
