"""A comparison as a plan of the sweep: each controller is a point, and all get the same seeds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from dnnmso_mj.errors import DnnmsoError, ScenarioError
from dnnmso_mj.loading import controller_set, load_scenario
from dnnmso_mj.loading.overrides import parse_overrides
from dnnmso_mj.paths import logs_dir
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.sweep.plan import Plan, Point, check_keys, ordered_seeds, ready_point
from dnnmso_mj.wording import clean, show

COLUMN = "controller"  # of the table: the name as it was asked for

CHOICES = {("controller",), ("controller", "from"), ("controller", "kind")}


class ComparisonError(DnnmsoError):
    """Controllers that cannot be compared."""


def parse_controllers(text: str) -> tuple[str, ...]:
    """Read "a,b,c".

    Raises:
        ComparisonError: fewer than two, an empty name, or a name twice.
    """
    place = f"--controllers {clean(text)}"
    form = "allowed: two or more different ones, as in no_network,dnn_mso"
    names = tuple(name.strip() for name in text.split(","))
    if not all(names):
        raise ComparisonError(f"{place}: an empty name; {form}")
    twice = [name for k, name in enumerate(names) if name in names[:k]]
    if twice:
        raise ComparisonError(f"{place}: {show(twice[0])} is there twice; {form}")
    if len(names) < 2:
        raise ComparisonError(f"{place}: one controller; {form}")
    return names


def plan_comparison(
    source: str | Path,
    controllers: Sequence[str],
    seeds: Iterable[int],
    sets: Sequence[str] = (),
    *,
    trust: bool = False,
) -> Plan:
    """Validate a scenario with each controller in its place, down to the first tick of a run.

    Args:
        source: a scenario file, or the name of a shipped one; its own controller has no part in it.
        controllers: each the name of a shipped tuned controller, a kind (its defaults), or a file.
        seeds: the same for each; any order.
        sets: "a.b=c", for every controller.
        trust: whether the scenario may name code by import path, as `load_scenario`.

    Raises:
        ScenarioError: as `load_scenario`; the place of a controller is `--controllers NAME`.
        ComparisonError: `sets` that choose a controller.
        SweepError: seeds.
    """
    overrides = parse_overrides(sets)
    check_keys(overrides)
    for item in overrides:
        if item.path in CHOICES:
            where = f"{item.place}: chooses a controller"
            raise ComparisonError(f"{where}, as --controllers does; allowed: --controllers alone")
    ordered = ordered_seeds(seeds)
    models: dict[str, Mjcf] = {}
    points = [controller_point(source, name, sets, models, trust) for name in controllers]
    return Plan(str(source), ordered, tuple(points))


def default_out(plan: Plan) -> Path:
    """logs/NAME.compare.parquet under the current directory."""
    return logs_dir() / f"{plan.points[0].scenario.name}.compare.parquet"


def controller_point(
    source: str | Path, name: str, sets: Sequence[str], models: dict[str, Mjcf], trust: bool
) -> Point:
    """A scenario with a controller in its place, checked down to its first tick.

    Args:
        source: a scenario file, or the name of a shipped one.
        name: of a shipped tuned controller, a kind (its defaults), or a file.
        sets: "a.b=c", put in afterwards.
        models: those read before, by name; a new one is added.
        trust: whether the scenario may name code by import path, as `load_scenario`.

    Raises:
        ScenarioError: as `load_scenario`; the place of the controller is `--controllers NAME`.
    """
    place = f"--controllers {clean(name)}"
    try:
        chosen = controller_set(name)
    except ScenarioError as error:
        raise ScenarioError(f"{place}: {error}") from error
    try:
        scenario = load_scenario(source, [chosen, *sets], trust=trust)
        point = ready_point(scenario, parse_overrides(sets), models)
    except ScenarioError as error:
        raise ScenarioError(str(error).replace(f"--set {clean(chosen)}:", f"{place}:")) from error
    return replace(point, parameters={COLUMN: name} | point.parameters)
