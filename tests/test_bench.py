"""The benchmark compares what computes the same, and tells of every contender. Nothing is timed."""

from __future__ import annotations

import importlib.util
import json
import math
import subprocess
import sys
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from dnnmso_mj.bench.environments import BareMujoco, arms
from dnnmso_mj.bench.growth import DEPTHS, JOINTS, WIDTHS, chain_arm, chain_scenario
from dnnmso_mj.bench.roofline import measure_roofline
from dnnmso_mj.bench.run import SECTIONS, Benchmark
from dnnmso_mj.bench.step import check_step, plain_torch
from dnnmso_mj.bench.tick import paper
from dnnmso_mj.bench.timing import ENOUGH_FOR_TAIL, Check, Contender, Table, race, timed
from dnnmso_mj.bench.torch_steps import FlatTorch, PlainTorch
from dnnmso_mj.network import Shape, initial_weights, network_shape
from dnnmso_mj.scenario import Madam, Network
from dnnmso_mj.simulation import simulate

ROOT = Path(__file__).parents[1]
PAPER_SHAPE = Shape((4, 64, 64, 64, 4), bias=True, activation="sigmoid")


def dnnmso(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "dnnmso_mj", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=240)


@pytest.fixture(scope="module")
def document() -> dict[str, Any]:
    done = dnnmso("bench", "--quick", "--json")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def tables(document) -> dict[str, dict[str, Any]]:
    return {table["name"]: table for table in document["tables"]}


def names(table: dict[str, Any]) -> list[str]:
    return [row["name"] for row in table["rows"]]


# ---- the whole benchmark, tried out ----


def test_every_contender_of_every_section_is_there(tables):
    assert names(tables["step"]) == [
        "dnnmso_mj, float32",
        "dnnmso_mj, float64",
        "plain PyTorch, float32",
        "PyTorch by hand, float32",
        "NumPy by hand, float32",
        "lower bound, float32",
        "lower bound, float64",
    ]
    assert names(tables["control"])[-2:] == ["dnn_mso_replay, float32", "plain PyTorch, float32"]
    assert names(tables["tick"])[3:] == [
        "bare mj_step from Python",
        "dm_control, Environment.step",
        "Gymnasium, MujocoEnv.step",
    ]
    assert "pool of PyTorch loops, 1 worker" in names(tables["sweep"])
    assert names(tables["recording"])[-1] == "mcap, mcap-protobuf: defaults"


@pytest.mark.parametrize(
    ("name", "axis"), [("width", WIDTHS), ("depth", DEPTHS), ("joints", JOINTS)]
)
def test_growth_has_every_point_of_every_curve(tables, name, axis):
    rows = tables[f"growth_{name}"]["rows"]
    curves = {row["curve"] for row in rows}
    assert {(row["curve"], row["at"]) for row in rows} == {(c, at) for c in curves for at in axis}
    assert len(curves) > 1


def test_every_row_is_a_positive_number_and_none_is_missing(tables):
    for table in tables.values():
        for row in table["rows"]:
            assert not row["missing"], row
            assert 0 < row["median"] < math.inf, row
            assert row["bounded_by"]


def test_every_comparison_was_of_the_same_work(tables):
    checks = {name: [c["what"] for c in table["checks"]] for name, table in tables.items()}
    assert [len(checks[name]) for name in ("step", "control", "tick", "recording")] == [7, 1, 3, 2]
    assert all(check["passed"] for table in tables.values() for check in table["checks"])


def test_a_document_says_what_it_was_made_on_and_with(document):
    assert document["status"] == "ok"
    assert document["quick"] is True
    assert document["machine"]["cpu"]
    assert document["machine"]["cores"] >= 1
    assert {"mujoco", "numba", "torch", "gymnasium"} <= set(document["versions"])
    assert document["date"].endswith("+00:00")


def test_without_torch_its_rows_say_how_to_get_it_and_the_rest_runs():
    hidden = "import sys; sys.modules['torch'] = None; from dnnmso_mj.cli import main; main()"
    command = [sys.executable, "-c", hidden, "bench", "step", "--quick"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("pip install 'dnnmso_mj[bench]'") == 2
    assert "same: NumPy by hand, float64" in done.stdout
    assert "same: plain PyTorch" not in done.stdout


def test_an_unknown_section_is_bad_input():
    done = dnnmso("bench", "stap")
    assert done.returncode == 2
    assert done.stdout == ""
    assert "'step'" in done.stderr
    assert all(name in done.stderr for name in SECTIONS)


# ---- the same work ----


def test_a_contender_with_another_learning_rate_is_found_out():
    def other(network: Network) -> PlainTorch:
        shape = network_shape(network, 4, 4)
        weights = initial_weights(shape, network, np.random.default_rng(0))
        return PlainTorch(shape, weights, Madam(eta=1.01e-3))

    assert not check_step("other", other, "float64", 50).passed
    assert check_step("same", plain_torch, "float64", 50).passed


@pytest.mark.parametrize("kind", [PlainTorch, FlatTorch])
def test_a_silent_gradient_moves_no_weight_of_a_torch_step(kind):
    weights = initial_weights(PAPER_SHAPE, Network(), np.random.default_rng(1))
    step = kind(PAPER_SHAPE, weights, Madam())
    step.predict(np.ones(4))
    step.learn(np.zeros(4))
    np.testing.assert_array_equal(step.weights(), weights)


def test_an_arm_under_another_torque_goes_elsewhere(two_link):
    scenario = paper(20)
    trace = simulate(scenario, two_link)
    for make in arms(scenario, two_link).values():
        arm = make()
        for tau in trace["tau"]:
            arm.step(tau * 1.001)
        assert np.abs(arm.state()[:2] - trace["q"][-1]).max() > 1e-6


def test_a_difference_that_is_no_number_fails_the_benchmark():
    check = Check("weights", math.nan, 1e-9)
    table = Table("t", "T", "work", "µs", (), (check,))
    done = Benchmark((table,), True, "", 0.0, None, None, {}, {}, "")
    assert done.unequal == ["weights"]
    document = done.document()
    assert document["status"] == "failed"
    assert document["tables"][0]["checks"][0]["error"] is None


# ---- timing ----


def test_contenders_take_turns():
    turns: list[str] = []

    def make(name: str):
        def probe() -> np.ndarray:
            turns.append(name)
            return np.ones(1)

        return probe

    race([Contender(n, "", partial(make, n)) for n in "AB"], rounds=3)
    assert "".join(turns) == "AB" + "ABABAB"  # one turn each to warm up


def test_a_ratio_is_taken_within_a_round_so_that_a_slow_one_changes_nothing():
    busy = iter([1.0, 10.0, 1.0])  # the neighbour wakes up in the second round
    factor = [1.0]

    def ours() -> np.ndarray:
        factor[0] = next(busy)
        return np.full(5, 2.0 * factor[0])

    def theirs() -> np.ndarray:
        return np.full(5, 6.0 * factor[0])

    contenders = [Contender("ours", "", lambda: ours), Contender("theirs", "", lambda: theirs)]
    rows = race(contenders, rounds=3, warm=False)
    assert rows[1].ratio == pytest.approx(3.0)
    assert (rows[1].median, rows[1].low, rows[1].high) == (6.0, 6.0, 60.0)
    assert rows[0].ratio is None


def test_a_rate_twice_as_large_is_not_slower_but_half_as_slow():
    made = {"one": 10.0, "two": 20.0}
    contenders = [Contender(n, "", lambda v=v: lambda: np.array([v])) for n, v in made.items()]
    assert race(contenders, 1, more_is_better=True)[1].ratio == pytest.approx(0.5)


def test_percentiles_are_told_only_of_enough_samples():
    few, many = (timed(lambda: None, count) for count in (ENOUGH_FOR_TAIL - 1, ENOUGH_FOR_TAIL))
    rows = race([Contender("few", "", lambda: few), Contender("many", "", lambda: many)], 1)
    assert rows[0].p999 is None
    assert rows[1].median <= rows[1].p99 <= rows[1].p999 <= rows[1].max


# ---- the lower bound and the chain ----


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_the_lower_bound_is_its_slowest_part_and_grows_with_the_weights(precision):
    roof = measure_roofline(PAPER_SHAPE, precision, quick=True)
    assert roof.bound_us == roof.us[roof.binding] == max(roof.us.values())
    assert min(roof.us.values()) > 0
    wide = Shape((4, 512, 512, 4), bias=True, activation="sigmoid")
    assert measure_roofline(wide, precision, quick=True).bound_us > roof.bound_us


@pytest.mark.parametrize("n", JOINTS)
def test_the_controller_follows_on_a_chain_of_any_length(n):
    scenario, mjcf = chain_scenario(n, 200), chain_arm(n)
    trace = simulate(scenario, mjcf)
    assert trace.info.status == "ok"
    assert np.abs(trace["q"] - trace["q_ref"]).max() < 0.7
    hanging = BareMujoco(mjcf.text, np.zeros(n), np.zeros(n))
    for _ in range(200):
        hanging.step(np.zeros(n))
    assert (
        np.abs(hanging.state()[:n] - trace["q_ref"][-1]).max()
        > np.abs(trace["q"][-1] - trace["q_ref"][-1]).max()
    )


# ---- the page ----


@pytest.fixture(scope="module")
def make_page() -> ModuleType:
    spec = importlib.util.spec_from_file_location("page", ROOT / "benchmarks" / "make_page.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_takes_all_numbers_and_keeps_its_words(make_page, document, tables):
    page = (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")
    once = make_page.with_numbers(page, document)
    assert make_page.with_numbers(once, document) == once
    assert once.split(make_page.BEGIN)[0] == page.split(make_page.BEGIN)[0]
    assert once.split(make_page.END)[1] == page.split(make_page.END)[1]
    for table in tables.values():
        assert table["title"] in once
        for row in table["rows"]:
            assert (row["curve"] or row["name"]) in once
            assert f"{row['median']:.4g}" in once


def test_the_picture_is_drawn(make_page, document, tmp_path):
    make_page.draw(document, tmp_path / "growth.png")
    assert (tmp_path / "growth.png").read_bytes().startswith(b"\x89PNG")
