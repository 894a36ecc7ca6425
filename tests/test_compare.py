"""Comparisons: the pairing's arithmetic, failures as worst, and the command with what it prints."""

from __future__ import annotations

import json
import math
import signal
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from sweep_samples import DNNMSO, dnnmso, rows_in, untimed, wait_until

from dnnmso_mj.comparison.pairing import corrected, log_ratios, pair, signed_rank_p
from dnnmso_mj.comparison.plan import ComparisonError, parse_controllers, plan_comparison
from dnnmso_mj.comparison.summary import Comparison, judged, summarise
from dnnmso_mj.errors import DnnmsoError, ScenarioError
from dnnmso_mj.sweep.local import LocalEngine
from dnnmso_mj.sweep.run import run_sweep
from dnnmso_mj.sweep.statistics import spread
from dnnmso_mj.sweep.table import ROW_SCHEMA

INF = math.inf
SETS = ["duration=0.12"]
# The paper's printed sign of the observer diverges within 0.05 s at this gain.
DIVERGES = "controller: {kind: dnn_mso, observer: {feedback: as_printed, K2: 300}}\n"
WEAK = "controller: {kind: no_network, inversion: {K: 1, lam: 1}}\n"


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("controllers")
    (folder / "diverges.yaml").write_text(DIVERGES)
    (folder / "weak.yaml").write_text(WEAK)
    return folder


@pytest.fixture(scope="module")
def names(files) -> list[str]:
    return [str(files / "weak.yaml"), "no_network", str(files / "diverges.yaml")]


@pytest.fixture(scope="module")
def table(names, files) -> pa.Table:
    plan = plan_comparison("paper", names, range(6), SETS)
    return run_sweep(plan, files / "x.parquet", LocalEngine(2)).table


@pytest.fixture(scope="module")
def found(table) -> Comparison:
    return summarise(table)


# The arithmetic


def test_p_of_six_wins_of_six_is_two_in_sixty_four():
    assert signed_rank_p(-np.arange(1.0, 7.0)) == pytest.approx(2 / 64, rel=1e-12)


def test_p_is_that_of_a_published_example():
    # Darwin's maize, crossed less selfed, in eighths of an inch (Fisher, The Design of Experiments,
    # 1935): of 15 pairs, the ranks of the two negative differences add up to 24.
    corn = np.array([49, -67, 8, 16, 6, 23, 28, 41, 14, 29, 56, 24, 75, 60, -48], float)
    ranks = np.argsort(np.argsort(np.abs(corn))) + 1
    assert ranks[corn < 0].sum() == 24
    assert signed_rank_p(corn) == pytest.approx(0.0413, abs=5e-5)


def test_p_is_one_where_nothing_differs():
    assert signed_rank_p(np.zeros(8)) == 1.0


def test_an_infinite_difference_has_the_highest_rank():
    finite = np.array([1.0, -2.0, 3.0, -4.0, 5.0, 6.0, 7.0])
    endless = np.array([1.0, -2.0, 3.0, -4.0, 5.0, 6.0, INF])
    assert signed_rank_p(endless) == signed_rank_p(finite)


def test_a_diverged_run_is_worse_than_all_and_as_bad_as_another():
    values, others = np.array([1.0, INF, INF, 2.0, 0.0]), np.array([INF, 1.0, INF, 2.0, 0.0])
    assert log_ratios(values, others).tolist() == [-INF, INF, 0.0, 0.0, 0.0]
    pairing = pair("a", "b", values, others)
    assert (pairing.wins, pairing.losses, pairing.ties) == (1, 1, 3)
    assert pairing.log_ratio.median == 0.0


def test_a_half_of_the_error_on_every_seed_is_a_log_ratio_of_ln_one_half():
    others = np.random.default_rng(3).uniform(0.1, 1.0, 20)
    pairing = pair("a", "b", 0.5 * others, others)
    assert pairing.log_ratio.median == pytest.approx(-math.log(2.0))
    assert pairing.log_ratio.ci_low == pytest.approx(-math.log(2.0))
    assert pairing.log_ratio.ci_high == pytest.approx(-math.log(2.0))
    assert (pairing.wins, pairing.losses, pairing.ties) == (20, 0, 0)
    assert pairing.p < 1e-4


def test_the_sign_of_a_pairing_turns_with_its_sides():
    rng = np.random.default_rng(5)
    values, others = rng.uniform(1, 2, (2, 30))
    one, other = pair("a", "b", values, others), pair("b", "a", others, values)
    assert one.log_ratio.median == pytest.approx(-other.log_ratio.median)
    assert (one.wins, one.losses) == (other.losses, other.wins)
    assert one.p == pytest.approx(other.p)


def test_holm_corrects_step_by_step_and_never_falls():
    rng = np.random.default_rng(0)
    some = [pair("a", "b", *rng.uniform(1, 2, (2, 8))) for _ in range(4)]
    given = [0.01, 0.04, 0.03, 0.005]  # Holm: 4·0.005, 3·0.01, 2·0.03, and 0.04 not below 0.06
    found = corrected([replace(item, p=p) for item, p in zip(some, given, strict=True)])
    assert [item.p_holm for item in found] == pytest.approx([0.03, 0.06, 0.06, 0.02])


@pytest.mark.parametrize(
    ("values", "median", "interval"),
    [
        ([1.0, 2.0, 3.0, 4.0, 5.0, INF], 3.5, (1.0, INF)),
        ([1.0] + [INF] * 7, INF, (1.0, INF)),
        ([-INF, -INF, -INF, INF, INF, INF], 0.0, (-INF, INF)),
    ],
)
def test_a_median_of_infinite_values_is_by_order_alone(values, median, interval):
    found = spread(np.array(values))
    assert found.median == median
    assert (found.ci_low, found.ci_high) == interval
    assert found.ci_method == "order statistics"


# The runs


def test_each_controller_gets_the_same_seeds_and_its_own_name(table, names):
    assert table["controller"].to_pylist() == [name for name in names for _ in range(6)]
    assert table["seed"].to_pylist() == [*range(6)] * 3


def test_runs_that_diverged_are_counted_and_never_dropped(table, found, names):
    last = found.standings[-1]
    assert last.controller == names[2]
    assert (last.runs, last.count("diverged"), len(last.failures)) == (6, 6, 6)
    for metric in ("rmse_steady", "tau_peak", "tau_chatter"):
        assert last.metrics[metric].median == INF
    assert last.metrics["compute_us_p50"].n == 6
    assert judged(table.slice(12, 6), "rmse_steady").tolist() == [INF] * 6


def test_they_stand_by_the_median_error(table, found, names):
    assert [standing.controller for standing in found.standings] == [names[1], names[0], names[2]]
    errors = table["rmse_steady"].to_numpy()
    assert found.standings[0].metrics["rmse_steady"].median == np.median(errors[6:12])


def test_each_is_paired_with_the_first_that_was_asked_for(table, found, names):
    better, worse = found.pairings
    assert [(item.controller, item.against) for item in found.pairings] == [
        (names[1], names[0]),
        (names[2], names[0]),
    ]
    errors = table["rmse_steady"].to_numpy()
    assert better.log_ratio.median == pytest.approx(np.median(np.log(errors[6:12] / errors[:6])))
    assert (better.wins, worse.losses) == (6, 6)
    assert worse.log_ratio.median == INF
    assert better.p == worse.p == pytest.approx(2 / 64)
    assert better.p_holm == worse.p_holm == pytest.approx(4 / 64)


def test_a_controller_s_rows_do_not_depend_on_its_rivals(table, files):
    plan = plan_comparison("paper", [str(files / "weak.yaml"), "dnn_mso"], range(2), SETS)
    other = run_sweep(plan, files / "y.parquet", LocalEngine(1)).table
    assert untimed(table.slice(0, 2)).equals(untimed(other.slice(0, 2)))


def test_a_table_of_something_else_is_refused():
    with pytest.raises(ComparisonError, match="no column controller; allowed"):
        summarise(ROW_SCHEMA.empty_table())


# What is refused


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("no_network", "--controllers no_network: one controller; allowed: two or more"),
        ("a,b,a", '"a" is there twice; allowed: two or more different'),
        ("a,,b", "an empty name; allowed"),
    ],
)
def test_lists_that_cannot_be_compared_are_refused(text, problem):
    with pytest.raises(ComparisonError, match=problem):
        parse_controllers(text)


def test_a_controller_that_is_not_there_is_named(files):
    names = ["no_network", "no_netwerk"]
    with pytest.raises(ScenarioError) as caught:
        plan_comparison("paper", names, range(2))
    assert str(caught.value).startswith('--controllers no_netwerk: no controller "no_netwerk"')


def test_a_set_that_one_of_them_does_not_know_is_refused():
    with pytest.raises(ScenarioError) as caught:
        plan_comparison("paper", ["dnn_mso", "no_network"], [0], ["controller.network.bias=false"])
    assert "controller.network" in str(caught.value)
    assert "unknown key" in str(caught.value)


@pytest.mark.parametrize("text", ["controller.kind=no_network", "controller.from=x", "seed=3"])
def test_a_set_that_chooses_the_controller_or_the_seed_is_refused(text):
    with pytest.raises(DnnmsoError, match="allowed: --"):
        plan_comparison("paper", ["dnn_mso", "no_network"], [0], [text])


# The command


def test_the_command_ranks_and_leaves_a_table(tmp_path, files):
    command = ("compare", "paper", "--controllers", "weak.yaml,no_network,diverges.yaml")
    (tmp_path / "weak.yaml").write_text(WEAK)
    (tmp_path / "diverges.yaml").write_text(DIVERGES)
    options = ("--seeds", "0:6", "--set", SETS[0])
    done = dnnmso(*command, *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert max(map(len, lines)) <= 80
    assert [line.split()[:2] for line in lines if line[:1].isdecimal()][:3] == [
        ["1", "no_network"],
        ["2", "weak.yaml"],
        ["3", "diverges.yaml"],
    ]
    assert "6 diverged, 0 failed" in done.stdout
    assert "paired by seed, against weak.yaml" in done.stdout
    assert "logs/paper.compare.parquet" in done.stdout
    assert pq.read_table(tmp_path / "logs" / "paper.compare.parquet").num_rows == 18
    again = dnnmso(*command, *options, "--resume", "--json", cwd=tmp_path)
    found = json.loads(again.stdout)
    assert found["rows_kept"] == 18
    assert found["against"] == "weak.yaml"
    assert [item["controller"] for item in found["standings"]] == [
        "no_network",
        "weak.yaml",
        "diverges.yaml",
    ]
    assert found["standings"][2]["diverged"] == 6
    assert found["standings"][2]["metrics"]["rmse_steady"]["median"] == "inf"
    assert found["pairings"][0]["wins"] == 6
    assert found["pairings"][0]["log_ratio"]["median"] < 0


def test_ctrl_c_keeps_rows_and_says_how_to_go_on(tmp_path):
    command = [str(DNNMSO), "compare", "paper", "--controllers", "no_network,dnn_mso"]
    command += ["--seeds", "0:200", "--set", "duration=3.0", "--out", "x.parquet"]
    process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    journal = tmp_path / "x.parquet.journal"
    wait_until(lambda: rows_in(journal) > 20)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "of 400 rows are kept beside x.parquet; to go on:" in error
    assert error.rstrip().endswith("--out x.parquet --resume")
    assert rows_in(journal) >= 20
