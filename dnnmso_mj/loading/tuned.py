"""`controller: {from: NAME}`: a tuned controller, put in place before the scenario is checked.

NAME is a shipped controller or a file. Keys that stand beside `from` override what the file holds,
group by group; a group whose `kind` they change is theirs alone. `--set controller.from=NAME`
replaces the whole controller, and every other `--set` changes what it brings, wherever it stands.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.loading.complaints import Complaint, explain
from dnnmso_mj.loading.documents import Node, Problem, read_document
from dnnmso_mj.loading.overrides import Override
from dnnmso_mj.loading.places import Places
from dnnmso_mj.loading.reach import PROBLEM, in_reach
from dnnmso_mj.loading.shape import ABSENT, Shape, lookup
from dnnmso_mj.loading.text import read_text
from dnnmso_mj.loading.trust import anchored
from dnnmso_mj.paths import controllers_dir, find_controller
from dnnmso_mj.scenario.tuned import TunedController
from dnnmso_mj.wording import KeyPath, clean, show

CONTROLLER = ("controller",)
FROM = ("controller", "from")


@dataclass(frozen=True)
class Graft:
    """A controller that was taken from a file of its own.

    Args:
        file: where it stands.
        root: that file.
        own: what stood beside `from`, and overrides it.
        cause: the `--set` that names it; None: the scenario does.
    """

    file: Path
    root: Node
    own: dict[str, Any]
    cause: Override | None = None

    def place(self, path: KeyPath) -> str | None:
        """FILE:LINE of what the file says at a path of the scenario; None where it is silent."""
        if path[:1] != CONTROLLER or len(path) == 1 or lookup(self.own, path[1:]) is not ABSENT:
            return None
        if lookup(self.root.plain(), path) is ABSENT:
            return None
        return f"{clean(str(self.file))}:{self.root.line_of(path)}"

    def controller(self) -> dict[str, Any]:
        """The file's controller, with what is set beside `from`."""
        base = anchored(self.root.plain()["controller"], self.file.absolute().parent)
        merged: dict[str, Any] = _merged(base, self.own)
        return merged


def graft_file(
    data: dict[str, Any], folder: Path, trust: bool
) -> tuple[list[Graft], list[Complaint]]:
    """Put the controller that a scenario names in its place in `data`.

    Args:
        data: the scenario, which is changed.
        folder: of the scenario, where relative paths begin.
        trust: whether that file may be out of reach; see `dnnmso_mj.loading.reach`.
    """
    found = _graft(data.get("controller"), folder, None, anywhere=trust)
    if isinstance(found, Complaint):
        data["controller"].pop("from")
        return [], [found]
    if found is None:
        return [], []
    data["controller"] = found.controller()
    return [found], []


def graft_sets(
    sets: Sequence[Override],
) -> tuple[tuple[Override, ...], list[Graft], list[Complaint]]:
    """Overrides that name a tuned controller, as overrides that hold it; relative to this folder.

    The last `controller.from` comes first, so that all others change what it brings.
    """
    named = [item for item in sets if item.path == FROM]
    changed, grafts, complaints = [], [], []
    for item in [*named[-1:], *(item for item in sets if item.path != FROM)]:
        value = {"from": item.value} if item.path == FROM else item.value
        found = _graft(value, Path.cwd(), item) if item.path in {FROM, CONTROLLER} else None
        if isinstance(found, Complaint):
            complaints.append(found)
            changed.append(Override(item.text, CONTROLLER, {}))
        elif found is not None:
            grafts.append(found)
            changed.append(Override(item.text, CONTROLLER, found.controller()))
        else:
            changed.append(item)
    return tuple(changed), grafts, complaints


def read_tuned(file: Path) -> Node:
    """A tuned controller's file, checked.

    Raises:
        ScenarioError: one line a problem, as `load_scenario`.
    """
    root, problems = read_document(read_text(file))
    places = Places(file, root, ())
    shape = Shape.of(TunedController)
    if root is None or not isinstance(root.value, dict):
        keys = f"allowed: the keys {', '.join(shape.keys)}"
        what = Problem(root.line if root else 1, f"the file holds no tuned controller; {keys}")
        raise ScenarioError(places.message(problems or [what], []))
    data = root.plain()
    complaints: list[Complaint] = []
    try:
        TunedController.model_validate(data)
    except ValidationError as error:
        complaints = explain(error, data, shape)
    if problems or complaints:
        raise ScenarioError(places.message(problems, complaints))
    return root


def _graft(
    value: Any, folder: Path, cause: Override | None, *, anywhere: bool = True
) -> Graft | Complaint | None:
    """What a controller with `from` is made of; None for one without."""
    if not isinstance(value, dict) or "from" not in value:
        return None
    name, own = value["from"], {key: below for key, below in value.items() if key != "from"}
    at = f"controller.from = {show(name)}"
    if not isinstance(name, str):
        allowed = "allowed: the name of a shipped controller, or a YAML file"
        return Complaint(FROM, f"{at}: is no name; {allowed}")
    try:
        file = find_controller(name, folder)
    except ScenarioError as error:
        return Complaint(FROM, f"{at}: {error}")
    if not anywhere and file.parent != controllers_dir() and not in_reach(file, folder):
        return Complaint(FROM, f"{at}: {PROBLEM.format(clean(str(folder)))}")
    found = Graft(file, read_tuned(file), own, cause)
    kind = found.root.plain()["controller"]["kind"]
    if own.get("kind", kind) != kind:
        problem = f"controller.kind = {show(own['kind'])}: {name} is {kind}"
        return Complaint((*CONTROLLER, "kind"), f"{problem}; allowed: from without kind")
    return found


def _merged(base: Any, own: Any) -> Any:
    """`own` over `base`, group by group."""
    groups = isinstance(base, dict) and isinstance(own, dict)
    if not groups or own.get("kind", base.get("kind")) != base.get("kind"):
        return deepcopy(own)
    return {
        key: _merged(base[key], own[key]) if key in base and key in own else deepcopy(value)
        for key, value in (base | own).items()
    }
