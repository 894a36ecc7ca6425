"""What a sweep will run: the grid's points times the seeds, all validated before anything runs."""

from __future__ import annotations

import itertools
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from dnnmso_mj.errors import DnnmsoError, ScenarioError
from dnnmso_mj.external.identity import code_digests
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.loading.overrides import Override, parse_overrides
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.provenance import git_commit, software_versions
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.simulation import simulate
from dnnmso_mj.sources import sources_digest
from dnnmso_mj.sweep.task import Task
from dnnmso_mj.wording import clean

MAX_POINTS = 10_000
MAX_SEEDS = 10_000_000
SEED_LIMIT = 2**63
# A task is what a worker gets at once: some seconds at most, so that dispatch costs nothing, and a
# thousandth of the sweep, so that no worker is left with much to do when the others are done.
TICKS_PER_TASK = 200_000
RUNS_PER_TASK = 64
TASKS_PER_SWEEP = 1000

_SEEDS = re.compile(r"([0-9]{1,19})(?::([0-9]{1,19}))?")
NUMBERS_DEPEND_ON = ("dnnmso_mj", "mujoco", "numpy", "numba")


class SweepError(DnnmsoError):
    """A sweep that cannot be accepted, gone on with or written."""


@dataclass(frozen=True)
class Point:
    """One point of the grid.

    Args:
        parameters: key path -> value, of every `--set` and `--grid`.
        scenario: the resolved scenario; its seed is replaced by each of the sweep's.
        mjcf: the model that it names.
    """

    parameters: dict[str, Any]
    scenario: Scenario
    mjcf: Mjcf


@dataclass(frozen=True)
class Plan:
    """A validated sweep.

    Args:
        source: the scenario as the caller named it.
        seeds: ascending, each once.
        points: the cartesian product of the grid, the last key varying fastest.
    """

    source: str
    seeds: tuple[int, ...]
    points: tuple[Point, ...]

    @property
    def n_runs(self) -> int:
        """How many rows the finished table has."""
        return len(self.points) * len(self.seeds)

    def tasks(self, done: Sequence[Set[int]]) -> Iterator[Task]:
        """What is left to run, in small tasks.

        Args:
            done: for each point, the seeds that have a row already.
        """
        for k, point in enumerate(self.points):
            most = TICKS_PER_TASK // point.scenario.n_ticks
            size = max(1, min(RUNS_PER_TASK, most, self.n_runs // TASKS_PER_SWEEP))
            left = (seed for seed in self.seeds if seed not in done[k])
            while seeds := tuple(itertools.islice(left, size)):
                yield Task(k, point.scenario, point.mjcf, seeds)

    def definition(self) -> dict[str, Any]:
        """Everything but the seeds that the numbers depend on, as JSON."""
        points = [
            {
                "parameters": point.parameters,
                "scenario": point.scenario.model_dump(mode="json", exclude={"seed"}),
            }
            for point in self.points
        ]
        return {
            "points": points,
            "models": {p.scenario.plant.model: p.mjcf.text for p in self.points},
            **code_identity(point.scenario for point in self.points),
        }


def code_identity(scenarios: Iterable[Scenario]) -> dict[str, Any]:
    """Which code the numbers of these scenarios come from, here."""
    versions, outside = software_versions(), code_digests(scenarios)
    return {
        **({"outside": outside} if outside else {}),
        "versions": {name: versions[name] for name in NUMBERS_DEPEND_ON},
        "git_commit": git_commit(),
        "source_sha256": sources_digest(),
    }


def plan_sweep(
    source: str | Path,
    seeds: Iterable[int],
    sets: Sequence[str] = (),
    grid: Sequence[str] = (),
    *,
    trust: bool = False,
) -> Plan:
    """Validate every point of a sweep, down to the first tick of a run.

    Args:
        source: a scenario file, or the name of a shipped one.
        seeds: of the initial weights; any order.
        sets: "a.b=c", for every point.
        grid: "a.b=1,2,3"; the points are the cartesian product.
        trust: whether the scenario may name code by import path, as `load_scenario`.

    Raises:
        ScenarioError: as `load_scenario`; the place of a grid's value is `--grid a.b=c`.
        SweepError: seeds, or keys that are set twice.
    """
    axes = [_axis(text) for text in grid]
    check_keys(parse_overrides(sets), axes)
    ordered = ordered_seeds(seeds)
    load = partial(load_scenario, trust=trust)
    models: dict[str, Mjcf] = {}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        points = [_point(load, source, sets, values, models) for values in itertools.product(*axes)]
    texts = [item.text for axis in axes for item in axis]
    said = {_as_grid(str(item.message), texts): item.category for item in caught}
    for message, category in said.items():
        warnings.warn(message, category, stacklevel=2)
    return Plan(str(source), ordered, tuple(points))


def parse_seeds(text: str) -> tuple[int, ...]:
    """Read "0:1000" (the stop is left out), "7", or a list of both: "0:10,20,30:40".

    Raises:
        SweepError: malformed, empty, or with a seed twice.
    """
    seeds: list[int] = []
    for piece in text.split(","):
        match = _SEEDS.fullmatch(piece.strip())
        if match is None:
            allowed = "allowed: START:STOP, a number, or a list of them, as in 0:100,200"
            raise SweepError(f"--seeds {clean(text)}: {clean(piece) or 'nothing'}; {allowed}")
        start = int(match[1])
        stop = start + 1 if match[2] is None else int(match[2])
        if stop <= start:
            raise SweepError(f"--seeds {clean(text)}: {piece} is empty; allowed: START < STOP")
        if stop - start + len(seeds) > MAX_SEEDS:
            allowed = f"allowed: at most {MAX_SEEDS}; split a larger sweep by seeds"
            raise SweepError(f"--seeds {clean(text)}: too many; {allowed}")
        seeds += range(start, stop)
    return ordered_seeds(seeds)


def seeds_text(seeds: Sequence[int]) -> str:
    """The shortest text that `parse_seeds` reads as these ascending seeds."""
    pieces = []
    for _, run in itertools.groupby(enumerate(seeds), key=lambda item: item[1] - item[0]):
        members = [seed for _, seed in run]
        first, last = members[0], members[-1]
        pieces.append(f"{first}" if first == last else f"{first}:{last + 1}")
    return ",".join(pieces)


def ordered_seeds(seeds: Iterable[int]) -> tuple[int, ...]:
    """Seeds in ascending order.

    Raises:
        SweepError: none, one twice, or one out of range.
    """
    ordered = sorted(seeds)
    if not ordered:
        raise SweepError("seeds: none; allowed: at least one")
    twice = [a for a, b in itertools.pairwise(ordered) if a == b]
    if twice:
        raise SweepError(f"seeds: {twice[0]} is there twice; allowed: each seed once")
    if ordered[0] < 0 or ordered[-1] >= SEED_LIMIT:
        worst = ordered[0] if ordered[0] < 0 else ordered[-1]
        raise SweepError(f"seeds: {worst} is out of range; allowed: 0 <= seed < 2**63")
    return tuple(ordered)


def _axis(text: str) -> tuple[Override, ...]:
    """One `--grid`, as one override a value."""
    place = f"--grid {clean(text)}"
    key, equals, values = text.partition("=")
    form = "allowed: KEY.PATH=VALUE,VALUE…, as in plant.gravity=1.62,9.81"
    if not equals:
        raise SweepError(f"{place}: no '='; {form}")
    pieces = [piece.strip() for piece in _split(values)]
    if not all(pieces):
        raise SweepError(f"{place}: an empty value; {form}")
    texts = [f"{key}={piece}" for piece in pieces]
    with _typed_as_grid(texts):
        axis = parse_overrides(texts)
    seen: list[Any] = []
    for item, piece in zip(axis, pieces, strict=True):
        if item.value in seen:
            raise SweepError(f"{place}: {clean(piece)} is there twice; allowed: each value once")
        seen.append(item.value)
    return axis


def _split(text: str) -> list[str]:
    """Split at the commas that stand outside brackets, braces and quotes."""
    pieces, depth, quote, start = [], 0, "", 0
    for k, letter in enumerate(text):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter in "[{":
            depth += 1
        elif letter in "]}":
            depth -= 1
        elif letter == "," and depth == 0:
            pieces.append(text[start:k])
            start = k + 1
    return [*pieces, text[start:]]


def check_keys(sets: Sequence[Override], axes: Sequence[tuple[Override, ...]] = ()) -> None:
    """Refuse a key that has two values, and a seed that `--seeds` would override.

    Raises:
        SweepError: such a key.
    """
    grid = [axis[0].path for axis in axes]
    paths = [*(item.path for item in sets), *grid]
    if ("seed",) in paths:
        raise SweepError("seed: has an option of its own; allowed: --seeds START:STOP")
    for one, other in itertools.permutations(dict.fromkeys(paths), 2):
        if other[: len(one)] == one:
            below, above = clean(".".join(other)), clean(".".join(one))
            raise SweepError(
                f"{below}: is a part of {above}, which is set too; allowed: one of the two"
            )
    for k, path in enumerate(grid):
        name = clean(".".join(path))
        if path in grid[:k]:
            raise SweepError(f"--grid {name}: given twice; allowed: one --grid a key")
        if any(item.path == path for item in sets):
            raise SweepError(f"--grid {name}: also in --set; allowed: one of the two")
    n_points = 1
    for axis in axes:
        n_points *= len(axis)
    if n_points > MAX_POINTS:
        raise SweepError(f"--grid: {n_points} points; allowed: at most {MAX_POINTS}")


def _point(
    load: Callable[..., Scenario],
    source: str | Path,
    sets: Sequence[str],
    values: Sequence[Override],
    models: dict[str, Mjcf],
) -> Point:
    texts = [item.text for item in values]
    with _typed_as_grid(texts):
        scenario = load(source, [*sets, *texts])
    return ready_point(scenario, (*parse_overrides(sets), *values), models)


def ready_point(
    scenario: Scenario, overrides: Sequence[Override], models: dict[str, Mjcf]
) -> Point:
    """A point of a plan, checked down to its first tick.

    Args:
        scenario: what `overrides` made.
        overrides: the point's parameters.
        models: those read before, by name; a new one is added.

    Raises:
        ScenarioError: the model cannot be used, or does not fit the scenario.
    """
    name = scenario.plant.model
    if name not in models:
        models[name] = Mjcf.read(find_model(name))
    # One tick refuses what the model refuses, and compiles once what every worker then loads.
    simulate(scenario.model_copy(update={"duration": scenario.dt}), models[name], watch=False)
    resolved = scenario.model_dump(mode="json")
    parameters = {".".join(item.path): _typed(item, resolved) for item in overrides}
    return Point(parameters, scenario, models[name])


def _typed(override: Override, resolved: Any) -> Any:
    """The value that was set, a whole number as a float where the scenario has floats."""
    value, there = override.value, resolved
    for key in override.path:
        if isinstance(there, dict) and key not in there:
            return value  # controller.from is gone when it has done its work
        there = there[int(key)] if isinstance(there, list) else there[key]
    if isinstance(there, list) and there and not isinstance(value, list):
        there = there[0]  # one number for all joints
    is_whole = isinstance(value, int) and not isinstance(value, bool)
    return float(value) if is_whole and isinstance(there, float) else value


@contextmanager
def _typed_as_grid(texts: Sequence[str]) -> Iterator[None]:
    """Inside, a refusal of one of `texts` is of `--grid`, as it was typed, not of `--set`."""
    try:
        yield
    except ScenarioError as error:
        raise ScenarioError(_as_grid(str(error), texts)) from error


def _as_grid(message: str, texts: Iterable[str]) -> str:
    for place in map(clean, texts):
        message = message.replace(f"--set {place}:", f"--grid {place}:")
    return message
