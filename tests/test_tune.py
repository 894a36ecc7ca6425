"""Tuning: the objective's tiers, what is searched, and a search that nothing can spoil."""

from __future__ import annotations

import json
import math
import os
import signal
import sqlite3
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy.engine.base import RootTransaction
from sweep_samples import DNNMSO, children, dnnmso, wait_until

from dnnmso_mj.errors import DnnmsoError, ScenarioError
from dnnmso_mj.loading import controller_kinds, kind_set, load_scenario
from dnnmso_mj.loading.shape import lookup
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.sweep.local import WorkerPool
from dnnmso_mj.sweep.plan import plan_sweep
from dnnmso_mj.sweep.task import Task, run_task
from dnnmso_mj.tuning import TuneError, TuneInterrupted
from dnnmso_mj.tuning.objective import LOST, OVER_LIMIT, Objective
from dnnmso_mj.tuning.run import Tuned, default_storage, tune
from dnnmso_mj.tuning.search import Request, Search
from dnnmso_mj.tuning.spaces import SPACES, B

SETS = ("duration=0.2",)
REQUEST = Request(
    "paper", "no_network", (1000, 1001), 5, SETS, test_seeds=(0, 1), command="dnnmso tune …"
)


def row(rmse: float = 1.0, *, peak: float = 10.0, chatter: float = 0.0, **more: Any) -> dict:
    metrics = {"rmse_steady": rmse, "tau_peak": peak, "tau_chatter": chatter}
    return {"seed": 0, "status": "ok", "ticks": 100} | metrics | more


def trials(storage: Path) -> list[float]:
    """Values of a study's finished trials, read without Optuna."""
    with sqlite3.connect(storage) as connection:
        query = "SELECT value FROM trial_values ORDER BY trial_id"
        return [value for (value,) in connection.execute(query)]


# The spaces


def test_every_kind_has_a_space_and_no_other_has():
    assert set(SPACES) == set(controller_kinds())


@pytest.mark.parametrize("kind", SPACES)
def test_every_path_is_a_number_of_the_kind_within_its_range(kind):
    spec = load_scenario("paper", [kind_set(kind)]).controller.model_dump(mode="json")
    for path, reach in SPACES[kind].items():
        value = lookup(spec, tuple(path.split(".")))
        assert isinstance(value, list) or not reach.factor, path
        value = value[0] if isinstance(value, list) and len(value) == 1 else value
        start = 1.0 if reach.factor else value
        assert isinstance(start, float), path
        assert reach.low <= start <= reach.high, path
        assert 0 < reach.low < reach.high or not reach.log, path


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("end", ["low", "high"])
@pytest.mark.parametrize("kind", SPACES)
def test_every_range_can_be_searched_to_its_ends(kind, end):
    search = Search(replace(REQUEST, controller=kind))
    values = {path: getattr(reach, end) for path, reach in search.space.items()}
    tried = search.with_values(values).controller.model_dump(mode="json")
    for path, value in values.items():
        found = lookup(tried, tuple(path.split(".")))
        if not search.space[path].factor:
            assert found in (value, [value]), path


def test_a_factor_multiplies_the_list_that_it_is_of():
    search = Search(replace(REQUEST, controller="slotine_li"))
    assert search.start["K_D"] == 1.0
    tried = search.with_values(search.start | {"K_D": 0.3}).controller
    assert pytest.approx((18.0, 7.5)) == tried.K_D  # of 60 and 25 N·m·s/rad
    assert tried.Gamma == search.scenario.controller.Gamma


@pytest.mark.parametrize(
    ("kind", "above"), [("dnn_mso", "inversion.effectiveness"), ("adrc", "effectiveness")]
)
def test_a_constant_effectiveness_is_tuned_and_a_model_is_not(kind, above):
    constant = f"controller.{above}.kind=constant"
    free = Search(replace(REQUEST, controller=kind, sets=(*SETS, constant)))
    knows = Search(replace(REQUEST, controller=kind))
    assert free.space == knows.space | {f"{above}.b": B}
    assert free.start[f"{above}.b"] == 1.0


# The objective


def test_the_objective_is_the_median_error_made_dear_by_chatter():
    rows = [row(1.0), row(3.0), row(2.0, chatter=0.05 * math.sqrt(3))]
    assert Objective().value(rows, 100) == pytest.approx(3.0)  # of 1, 3 and 2·2
    assert Objective(chatter_scale=1e9).value(rows, 100) == pytest.approx(2.0)


def test_a_lost_run_is_worse_than_any_kept_and_better_the_later_it_is_lost():
    terrible = Objective().value([row(900.0, chatter=1e6)] * 2, 100)
    over = Objective(max_peak=0.001).value([row()] * 2, 100)
    late = Objective().value([row(), row(status="diverged", ticks=90, rmse_steady=None)], 100)
    early = Objective().value([row(), row(status="diverged", ticks=10)], 100)
    both = Objective().value([row(status="diverged", ticks=10)] * 2, 100)
    none = Objective().value([row(status="failed", ticks=0)] * 2, 100)
    assert terrible <= OVER_LIMIT < over < 2 * OVER_LIMIT < LOST < late < early < both < none
    assert late == pytest.approx(LOST * 1.05)
    assert none == 2 * LOST


def test_limits_are_of_the_worst_run_and_ordered_by_excess():
    limited = Objective(max_peak=100.0, max_chatter=0.02)
    assert limited.value([row(peak=100.0, chatter=0.02)], 100) < 2.0
    little = limited.value([row(), row(peak=110.0)], 100)
    more = limited.value([row(), row(chatter=0.04)], 100)
    assert little == pytest.approx(OVER_LIMIT * (1.0 + 0.1 / 1.1))
    assert more == pytest.approx(OVER_LIMIT * 1.5)


def test_a_run_without_the_metric_is_refused_not_taken_for_perfect():
    with pytest.raises(TuneError, match=r"seed 0: has no tau_chatter; allowed: a longer"):
        Objective().value([row(tau_chatter=None)], 100)


def test_the_record_says_the_constants():
    words = Objective(0.07, max_peak=90.0).words
    assert "rmse_steady" in words
    assert "0.07" in words
    assert "tau_peak <= 90" in words


# The search


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> Tuned:
    return tune(REQUEST, tmp_path_factory.mktemp("tuned") / "x.yaml", jobs=2)


def objective_of(scenario: Scenario, mjcf: Mjcf) -> float:
    """What the tuning seeds make of a scenario, without a search."""
    rows = list(run_task(Task(0, scenario, mjcf, tuple(REQUEST.seeds))))
    return Objective().value(rows, scenario.n_ticks)


def test_the_first_trial_is_the_untuned_controller(undisturbed, two_link):
    untuned = load_scenario("paper", SETS, controller="no_network")
    assert trials(undisturbed.storage)[0] == objective_of(untuned, two_link)
    assert undisturbed.start_value == trials(undisturbed.storage)[0]


def test_the_winner_is_the_best_of_the_budget_and_is_what_was_tried(undisturbed, two_link):
    values = trials(undisturbed.storage)
    assert len(values) == REQUEST.trials
    assert undisturbed.value == min(values) < undisturbed.start_value
    assert undisturbed.best == values.index(min(values))
    taken = load_scenario("paper", SETS, controller=str(undisturbed.out))
    assert objective_of(taken, two_link) == undisturbed.value


def test_test_seeds_judge_the_first_and_the_best(undisturbed):
    # Without noise, a controller without a network does the same whatever the seed.
    assert undisturbed.test_value == undisturbed.value
    assert undisturbed.test_start_value == undisturbed.start_value


def test_the_file_is_taken_by_a_scenario_and_says_how_it_was_found(undisturbed):
    loaded = load_scenario("paper", [f"controller.from={undisturbed.out}", *SETS])
    assert loaded.controller == undisturbed.scenario.controller
    assert load_scenario("paper", controller=str(undisturbed.out)).controller == loaded.controller
    (gain,) = loaded.controller.inversion.K
    assert gain == undisturbed.parameters["inversion.K"]
    text = undisturbed.out.read_text()
    for part in ("budget: 5", "seeds: 1000:1002", "scenario: paper", "command: dnnmso tune …"):
        assert part in text
    assert "slack_matrix: null" in text


class Stops:
    """Ctrl-C after some trials."""

    def __init__(self, after: int) -> None:
        self.after = after

    def begin(self, total: int, kept: int) -> None:
        pass

    def trial(self, done: int, value: float, best: float) -> None:
        if done == self.after:
            raise KeyboardInterrupt


def test_an_interrupted_search_comes_to_the_same_winner(undisturbed, tmp_path):
    out = tmp_path / "x.yaml"
    with pytest.raises(TuneInterrupted, match="3 trials are kept"):
        tune(REQUEST, out, watcher=Stops(3), jobs=1)
    assert not out.exists()
    done = tune(REQUEST, out, resume=True, jobs=1)
    assert done.kept == 3
    assert trials(done.storage) == trials(undisturbed.storage)
    assert done.parameters == undisturbed.parameters


@pytest.mark.parametrize("at", [1, 41, 46, 51, 56])
def test_a_ctrl_c_in_the_middle_of_a_commit_waits_for_its_end(
    undisturbed, tmp_path, monkeypatch, at
):
    """Pressed for real where SQLAlchemy would make an AssertionError of it."""
    finish, commits = RootTransaction._deactivate_from_connection, 0

    def press(transaction):
        nonlocal commits
        commits += 1
        if commits == at:
            os.kill(os.getpid(), signal.SIGINT)
        finish(transaction)

    out = tmp_path / "x.yaml"
    with monkeypatch.context() as patch:
        patch.setattr(RootTransaction, "_deactivate_from_connection", press)
        with pytest.raises(TuneInterrupted if at > 1 else KeyboardInterrupt) as stop:
            tune(REQUEST, out, jobs=1)
    assert default_storage(out).exists() == (at > 1), "a study without any trial is left"
    if at > 1:
        assert str(stop.value) == f"{len(trials(default_storage(out)))} trials are kept"
    done = tune(REQUEST, out, resume=True, jobs=1)
    assert trials(done.storage) == trials(undisturbed.storage)
    assert done.parameters == undisturbed.parameters


def test_workers_stay_for_the_next_batch_unless_one_is_left_early():
    point = plan_sweep("paper", [0], [*SETS, "controller.kind=no_network"]).points[0]
    tasks = [Task(0, point.scenario, point.mjcf, (seed,)) for seed in range(9)]
    with WorkerPool(2) as pool:
        first = list(pool.rows(tasks))
        processes = set(children(os.getpid()))
        second = list(pool.rows(tasks))
        assert set(children(os.getpid())) == processes
        assert sorted(r["seed"] for r in first) == sorted(r["seed"] for r in second) == [*range(9)]
        rows = pool.rows(tasks)
        next(rows)
        rows.close()
        after = pool.rows([Task(1, point.scenario, point.mjcf, (20,))])
        assert [(r["point"], r["seed"]) for r in after] == [(1, 20)]


# What is refused


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"test_seeds": (5, 1001)}, "--test-seeds: 1001 are tuning seeds too; allowed: seeds that"),
        ({"trials": 0}, "--trials 0: allowed: 1 or more"),
        ({"seeds": ()}, "seeds: none"),
        ({"sets": ("controller.kind=dnn_mso",)}, "chooses a controller, as --controller does"),
        (
            {"sets": ("controller.inversion={K: 3, lam: 3}",)},
            "--set: holds all that is tuned of no_network: inversion.K, inversion.lam; allowed",
        ),
    ],
)
def test_what_cannot_be_tuned_is_refused_before_anything_runs(tmp_path, changes, problem):
    with pytest.raises(DnnmsoError) as caught:
        tune(replace(REQUEST, **changes), tmp_path / "x.yaml")
    assert problem in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("value", "problem"),
    [
        ("[1, 2, 3, 4]", "controller.inversion.K = [1.0, 2.0, 3.0, 4.0]: one number is tuned"),
        ("9, lam: 0", "controller.inversion.lam = 0.0: tuned by its logarithm; allowed: > 0"),
    ],
)
def test_a_start_that_is_not_one_number_is_refused(tmp_path, value, problem):
    file = tmp_path / "start.yaml"
    file.write_text(f"controller: {{kind: no_network, inversion: {{K: {value}}}}}\n")
    with pytest.raises(TuneError) as caught:
        tune(replace(REQUEST, controller=str(file)), tmp_path / "x.yaml")
    assert problem in str(caught.value)


def test_an_objective_without_a_scale_is_refused():
    with pytest.raises(TuneError, match="--max-peak -1: allowed: a finite number > 0"):
        Objective(max_peak=-1.0)


def test_what_is_there_is_neither_lost_nor_mixed_up(tmp_path):
    out = tmp_path / "x.yaml"
    request = replace(REQUEST, trials=2, test_seeds=(), sets=(*SETS, "controller.inversion.K=5"))
    done = tune(request, out, jobs=1)
    assert list(done.parameters) == ["inversion.lam"]  # what is set is not tuned
    assert done.scenario.controller.inversion.K == (5.0,)
    before = out.read_text()
    for again, options, problem in (
        (request, {}, "x.yaml: exists; allowed: --resume to go on"),
        (replace(request, seeds=(7,)), {"resume": True}, 'seeds: "1000:1002"; now: "7"'),
        (request, {"resume": True, "force": True}, "allowed: one of them"),
        (replace(request, trials=1), {"resume": True}, "has 2 trials already; allowed: 2 or more"),
    ):
        with pytest.raises(TuneError) as caught:
            tune(again, out, **options)
        assert problem in str(caught.value)
    out.unlink()
    with pytest.raises(TuneError, match=r"sqlite: a study is there; allowed: --resume"):
        tune(request, out)
    tune(request, out, force=True, jobs=1)
    assert len(trials(default_storage(out))) == 2
    assert out.read_text() == before


@pytest.mark.parametrize("content", [b"a letter", b"SQLite format 3\0"])
def test_files_of_something_else_are_never_written_over(tmp_path, content):
    out, storage = tmp_path / "x.yaml", tmp_path / "x.sqlite"
    storage.write_bytes(content)
    with pytest.raises(TuneError, match=r"x.sqlite: exists and is not a study of `dnnmso tune`"):
        tune(REQUEST, out, storage, force=True)
    assert storage.read_bytes() == content
    out.write_text("name: x\n")
    with pytest.raises(TuneError, match=r"x.yaml: exists and is not a tuned controller"):
        tune(REQUEST, out, force=True)
    assert out.read_text() == "name: x\n"


def test_an_untuned_controller_that_cannot_run_is_an_error(tmp_path):
    with pytest.raises(ScenarioError, match="no model"):
        tune(replace(REQUEST, sets=("plant.model=nowhere",)), tmp_path / "x.yaml")
    assert list(tmp_path.iterdir()) == []


CORRUPTIONS = {
    "a value": "UPDATE trial_values SET value = value / 2 WHERE trial_id = 2",
    "a parameter": "UPDATE trial_params SET param_value = 9.5 WHERE trial_id = 2",
    "a parameter's name": "UPDATE trial_params SET param_name = 'inversion.lbm' "
    "WHERE trial_id = 2 AND param_name = 'inversion.lam'",
    "a state": "UPDATE trials SET state = 'COMPLE E' WHERE trial_id = 2",
    "what is tuned": "UPDATE study_user_attributes SET value_json = '{' || value_json",
    "a distribution": "UPDATE trial_params SET distribution_json = '{}'",
    "no value": "DELETE FROM trial_values WHERE trial_id = 2",
}


@pytest.mark.parametrize("statement", CORRUPTIONS.values(), ids=CORRUPTIONS)
def test_a_damaged_study_is_one_error(undisturbed, tmp_path, statement):
    storage = tmp_path / "x.sqlite"
    storage.write_bytes(undisturbed.storage.read_bytes())
    with sqlite3.connect(storage) as connection:
        assert connection.execute(statement).rowcount > 0
    connection.close()
    with pytest.raises(TuneError) as caught:
        tune(REQUEST, tmp_path / "x.yaml", storage, resume=True, jobs=1)
    assert f"{storage}: the study is damaged: " in str(caught.value)
    assert str(caught.value).endswith("allowed: another --storage, or remove it first")
    assert not (tmp_path / "x.yaml").exists()


def test_a_study_of_any_flipped_bits_is_one_error_or_the_same_winner(undisturbed, tmp_path):
    rng = np.random.default_rng(0)
    storage, out, whole = tmp_path / "x.sqlite", tmp_path / "x.yaml", undisturbed.storage
    refused = 0
    for _ in range(40):
        content = bytearray(whole.read_bytes())
        for at in rng.integers(0, len(content), 20):
            content[at] ^= 1 << rng.integers(0, 8)
        storage.write_bytes(content)
        try:
            done = tune(REQUEST, out, storage, resume=True, jobs=1)
            assert done.parameters == undisturbed.parameters
        except TuneError:
            refused += 1
    assert 0 < refused < 40


# The command

COMMAND = ("tune", "paper", "--controller", "no_network", "--seeds", "1000:1002")


def test_ctrl_c_keeps_trials_and_the_same_command_goes_on(tmp_path):
    options = ("--trials", "60", "--set", "duration=1", "--out", "x.yaml")
    process = subprocess.Popen(
        [str(DNNMSO), *COMMAND, *options], cwd=tmp_path, stderr=subprocess.PIPE, text=True
    )
    storage = tmp_path / "x.study.sqlite"

    def some() -> bool:
        try:
            return len(trials(storage)) >= 3
        except sqlite3.Error:
            return False

    wait_until(lambda: storage.exists() and some())
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130, error
    kept = len(trials(storage))
    assert f"{kept} of 60 trials are kept beside x.study.sqlite; to go on:" in error
    assert not (tmp_path / "x.yaml").exists()
    busy = [*COMMAND, "--trials", str(kept + 2), *options[2:], "--resume", "--json"]
    done = dnnmso(*busy, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["trials_kept"] == kept
    assert found["value"] <= found["start_value"]
    assert len(trials(storage)) == kept + 2


def test_the_command_says_what_it_found(tmp_path):
    options = ("--trials", "1", "--set", "duration=0.2", "--out", "x.yaml")
    done = dnnmso(*COMMAND, *options, "--test-seeds", "0:2", "--jobs", "1", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    for part in ("untuned", "on test seeds", "inversion.K", "rmse_steady", "x.study.sqlite"):
        assert part in done.stdout
