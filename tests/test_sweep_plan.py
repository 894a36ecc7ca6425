"""What a sweep will run: seeds, grid, and every refusal before anything runs."""

from __future__ import annotations

import warnings

import pytest

from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.loading import ScenarioWarning, load_scenario
from dnnmso_mj.sweep.plan import parse_seeds, plan_sweep, seeds_text
from dnnmso_mj.sweep.run import make_engine

SHORT = "duration=0.01"


@pytest.mark.parametrize(
    ("text", "seeds"),
    [
        ("0:4", (0, 1, 2, 3)),
        ("7", (7,)),
        ("5,3,9", (3, 5, 9)),
        ("10:12, 0:2,5", (0, 1, 5, 10, 11)),
        (str(2**63 - 1), (2**63 - 1,)),
    ],
)
def test_seeds_are_read_and_put_in_order(text, seeds):
    assert parse_seeds(text) == seeds


def test_seeds_text_is_the_inverse_of_parse_seeds():
    for text in ("0:1000", "7", "0:2,5,10:12"):
        assert seeds_text(parse_seeds(text)) == text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "nothing; allowed: START:STOP"),
        ("4:4", "4:4 is empty; allowed: START < STOP"),
        ("5:2", "5:2 is empty"),
        ("-1:3", "-1:3; allowed"),
        ("1e3", "1e3; allowed"),
        ("0:3,2", "2 is there twice"),
        ("0:3,", "nothing; allowed"),
        (str(2**63), f"{2**63} is out of range"),
        ("0:10000001", "too many; allowed: at most 10000000"),
    ],
)
def test_bad_seeds_are_refused_in_words(text, message):
    with pytest.raises(DnnmsoError) as refusal:
        parse_seeds(text)
    assert message in str(refusal.value)


def test_the_grid_is_the_product_with_the_last_key_fastest():
    grid = ["plant.gravity=1,2", "controller.madam.eta=1e-3,2e-3,5e-3"]
    plan = plan_sweep("paper", [1, 0], [SHORT], grid)
    values = [tuple(point.parameters.values()) for point in plan.points]
    assert values == [(0.01, g, eta) for g in (1.0, 2.0) for eta in (0.001, 0.002, 0.005)]
    assert plan.seeds == (0, 1)
    assert plan.n_runs == 12
    assert plan.points[4].scenario.controller.madam.eta == 0.002


def test_values_are_typed_as_the_scenario_has_them():
    sets = [SHORT, "controller.inversion.K=8", "controller.network.hidden=[8, 8]"]
    grid = ["plant.masses=[1, 2], [2,3]", "controller.madam.bias_correction=true,false"]
    parameters = plan_sweep("paper", [0], sets, grid).points[0].parameters
    assert parameters == {
        "duration": 0.01,
        "controller.inversion.K": 8.0,
        "controller.network.hidden": [8, 8],
        "plant.masses": [1, 2],
        "controller.madam.bias_correction": True,
    }
    assert isinstance(parameters["controller.inversion.K"], float)


def test_each_point_is_what_the_loader_makes_of_the_same_sets():
    plan = plan_sweep("paper", [0], [SHORT], ["plant.gravity=1.62,9.81"])
    assert plan.points[0].scenario == load_scenario("paper", [SHORT, "plant.gravity=1.62"])


@pytest.mark.parametrize(
    ("sets", "grid", "message"),
    [
        ([], ["plant.gravity=1,-1"], "--grid plant.gravity=-1: plant.gravity = -1: is out of"),
        ([], ["plant.gravty=1,2"], "did you mean 'gravity'"),
        (["plant.gravity=-1"], [], "--set plant.gravity=-1: plant.gravity = -1"),
        ([], ["plant.gravity"], "--grid plant.gravity: no '='"),
        ([], ["plant.gravity=1,,2"], "an empty value"),
        ([], ["plant.gravity="], "an empty value"),
        ([], ["plant.gravity=1,1.0"], "1.0 is there twice"),
        ([], ["plant.masses=[1,2],[1,2"], "--grid plant.masses=[1,2"),
        ([], ["plant.gravity=1", "plant.gravity=2"], "given twice"),
        (["plant.gravity=1"], ["plant.gravity=2,3"], "also in --set"),
        ([], ["plant.gravity=1.62,9.81", "plant={gravity: 3}"], "gravity: is a part of plant"),
        (["plant={gravity: 3.0}"], ["plant.gravity=1,2"], "plant.gravity: is a part of plant"),
        (["plant.masses.0=1"], ["plant.masses=[1,2]"], "plant.masses.0: is a part of plant.masses"),
        (["seed=4"], [], "--seeds"),
        ([], ["seed=1,2"], "--seeds"),
        ([], ["initial.q=[1],[1,2]"], "initial.q"),
        ([], ["plant.model=two_link,three_link"], "three_link"),
        ([], [f"plant.gravity={','.join(map(str, range(1, 102)))}"]
         + [f"initial.q.{k}={','.join(map(str, range(100)))}" for k in (0, 1)], "1010000 points"),
    ],
)  # fmt: skip
def test_bad_input_is_refused_with_its_place(sets, grid, message):
    with pytest.raises(DnnmsoError) as refusal:
        plan_sweep("paper", [0], sets, grid)
    assert message in str(refusal.value)


def test_a_model_that_does_not_compile_is_refused_before_anything_runs(tmp_path):
    (tmp_path / "wrong.xml").write_text("<mujoco><worldbody><body/></worldbody></mujoco>")
    wrong = f"plant.model={tmp_path / 'wrong.xml'}"
    with pytest.raises(DnnmsoError, match=r"wrong\.xml"):
        plan_sweep("paper", [0], [wrong, "plant.masses=null", "plant.lengths=null"])


def test_a_warning_is_said_once_for_each_place_not_once_for_each_point():
    grid = ["controller.madam.eta=1e-3,2e-3,5e-3"]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        plan_sweep("paper", [0], [SHORT, "imperfections.torque_limit=30"], grid)
    assert [item.category for item in caught] == [ScenarioWarning]


def test_a_warning_of_a_grid_value_names_the_grid():
    with pytest.warns(ScenarioWarning) as caught:
        plan_sweep("paper", [0], [SHORT], ["imperfections.torque_limit=30,31"])
    places = [str(item.message).partition(": ")[0] for item in caught]
    assert places == [f"--grid imperfections.torque_limit={limit}" for limit in (30, 31)]


def test_tasks_cover_every_run_once_and_leave_out_what_is_done():
    plan = plan_sweep("paper", range(5000), [SHORT], ["plant.gravity=1,2"])
    done = [set(range(1000)), {4999}]
    runs = [(task.point, seed) for task in plan.tasks(done) for seed in task.seeds]
    assert len(runs) == len(set(runs)) == 10_000 - 1001
    assert {len(task.seeds) for task in plan.tasks(done)} == {10, 9}


@pytest.mark.parametrize(
    ("seeds", "duration", "size"),
    [(100, 10, 1), (100_000, 10, 20), (100_000, 0.01, 64), (100_000, 600, 1)],
)
def test_tasks_are_small_and_a_sweep_has_many(seeds, duration, size):
    plan = plan_sweep("paper", range(seeds), [f"duration={duration}"])
    assert len(next(plan.tasks([set()])).seeds) == size


@pytest.mark.parametrize(
    ("name", "address", "message"),
    [("spark", None, "allowed: local, ray"), ("local", "auto", "with --engine ray")],
)
def test_an_engine_that_cannot_be_is_refused(name, address, message):
    with pytest.raises(DnnmsoError) as refusal:
        make_engine(name, None, address)
    assert message in str(refusal.value)
