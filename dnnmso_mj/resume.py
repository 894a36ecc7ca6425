"""Go on from any tick of a log: as it was, to the last bit, or with something changed.

The state at a tick is computed again from the snapshot before it, and held against the log on the
way, so that nothing goes on from a state that the log's run was never in.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from dnnmso_mj.assets import named_files, put_back, read_assets
from dnnmso_mj.branching import branch
from dnnmso_mj.continuing import Continuation, Model
from dnnmso_mj.errors import LogError, ScenarioError
from dnnmso_mj.loading.changing import MODEL, change_scenario
from dnnmso_mj.loading.overrides import parse_overrides
from dnnmso_mj.log.segments import Segment
from dnnmso_mj.logged import LoggedRun
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.recomputing import state_at
from dnnmso_mj.recorded import Recorded, read_recorded
from dnnmso_mj.run import MAX_NUMBERED
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.simulation import Progress, Simulation


@dataclass(frozen=True)
class Resumed:
    """A run that went on from a log.

    Args:
        run: the whole run, from its first tick, and its log.
        tick: where it went on.
        checked: how many ticks before that were computed again and are those of the log.
        told: the event that says what was changed there; "" for nothing.
    """

    run: LoggedRun
    tick: int
    checked: int
    told: str


def resume(
    log: Path,
    at: float,
    sets: Sequence[str] = (),
    out: Path | None = None,
    *,
    force: bool = False,
    trust: bool = False,
    progress: Progress | None = None,
) -> Resumed:
    """Run a log's scenario on from a time in it, and leave a log of the whole.

    Args:
        log: complete, interrupted or torn.
        at: when (s), from 0 to where the log ends; at the nearest tick.
        sets: `--set` strings that change the scenario from then on; see `branching`.
        out: the new log; by default LOG-from-AT.mcap beside the log, with a number where that
            exists.
        force: whether an existing `out` is replaced.
        trust: whether the log's scenario and `sets` may name code by import path.
        progress: called now and then with the number of ticks done since.

    Raises:
        LogError: the log cannot be read, does not reach to `at`, or is not computed again as it
            was; or `out` exists or cannot be written.
        ScenarioError: the changed scenario cannot be run, or not from there.
        UnloggedRunError: the new log could not be written on; it holds the run until then.
        RunInterrupted: Ctrl-C; the new log is whole, with the metrics of what was run.
    """
    source = read_recorded(log)
    if out is not None and out.resolve() == log.resolve():
        raise LogError(f"--out {out}: is the log itself; allowed: another name")
    tick = _tick(source, at)
    scenario = change_scenario(source.segment(tick).scenario, sets, log, trust=trust)
    if scenario.n_ticks < tick:
        raise ScenarioError(
            f"duration = {scenario.duration:g}: ends before --at {at:g}; allowed: {at:g} or more"
        )
    with TemporaryDirectory(prefix="dnnmso-") as folder:
        rest, checked = _prepare(source, tick, scenario, sets, Path(folder))
        where = {"source": log.name, "at": repr(at), "sets": json.dumps(list(sets))}
        outs = _names(log, tick * scenario.dt) if out is None else [out]
        done = rest.record(outs, where, force and out is not None, progress)
    return Resumed(done, tick, checked, rest.last.told if rest.last.first == tick else "")


def _prepare(
    source: Recorded, tick: int, scenario: Scenario, sets: Sequence[str], folder: Path
) -> tuple[Continuation, int]:
    """What is left to run, and how many ticks before it were computed again.

    Args:
        source: the log.
        tick: of it, to go on from.
        scenario: to go on in.
        sets: `--set` strings that made it; a model that they name is the file as it is now.
        folder: for the files of models.
    """
    segment = source.segment(tick)
    own = _model(source, segment, folder)
    named = any(item.covers(MODEL) for item in parse_overrides(sets))
    model = _model_file(scenario.plant.model) if named else own
    simulation = Simulation(scenario, model.mjcf)
    state, checked, events = state_at(source, segment, own.mjcf, tick)
    if scenario != segment.scenario or model[1:] != own[1:]:
        told = ""
        if state is not None:
            state, became = branch(state, segment.scenario, simulation)
            told = f"resumed from {source.path.name} with {', '.join(sets)}; {became}"
        segment = Segment(tick, scenario, told=told)
    return Continuation(source, tick, events, segment, state, simulation, model), checked


def _tick(source: Recorded, at: float) -> int:
    """The tick nearest to a time in the log."""
    dt, ticks = source.trace.scenario.dt, len(source.trace)
    if not math.isfinite(at / dt) or not 0 <= round(at / dt) <= ticks:
        raise LogError(f"{source.path}: --at {at:g}: allowed: 0 to {ticks * dt:g} s, its end")
    return round(at / dt)


def _model(source: Recorded, segment: Segment, folder: Path) -> Model:
    """The model of a segment, from the log alone; its meshes go to a folder."""
    text = source.model(segment.model)
    files = named_files(text, source.files)
    return Model(put_back(text, files, folder), text, files)


def _model_file(name: str) -> Model:
    mjcf = Mjcf.read(find_model(name))
    return Model(mjcf, mjcf.text, read_assets(mjcf))


def _names(log: Path, at: float) -> Iterator[Path]:
    """LOG-from-AT.mcap, LOG-from-AT-2.mcap …"""
    stem = f"{log.stem}-from-{at:g}"
    numbers = ("", *(f"-{k}" for k in range(2, MAX_NUMBERED)))
    return (log.with_name(f"{stem}{number}.mcap") for number in numbers)
