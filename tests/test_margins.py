"""Margins: the search against known thresholds, the rows, the cards, and tables made in parts."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from sweep_samples import dnnmso, rows_in

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.loading import controller_kinds, load_scenario
from dnnmso_mj.margins.cards import cell_text, interval_text, margins_of, rank, unfound, value_text
from dnnmso_mj.margins.plan import MarginPlan, MarginTask, model_free, plan_margins
from dnnmso_mj.margins.rows import ROWS, MarginError, is_model_free, nominal_model, parse_rows
from dnnmso_mj.margins.run import run_margins
from dnnmso_mj.margins.search import HALVINGS, PRECISION, PROBES_BELOW, find_margin
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.simulation import simulate
from dnnmso_mj.sweep.journal import journal_path
from dnnmso_mj.sweep.plan import SweepError

# Held level from the start on, stiffly: what the arm weighs is all that matters.
HELD = (
    "duration=1",
    "initial.q=[0, 0]",
    "reference={kind: setpoint, start: [0, 0], goal: [0, 0], blend_time: 0.1}",
)
STIFF = (*HELD, "controller.inversion.K=50", "controller.inversion.lam=50")
CONSTANT = "controller.inversion.effectiveness={kind: constant}"


def test_the_margin_encloses_the_threshold_to_the_precision():
    rng = np.random.default_rng(3)
    for threshold in np.exp(rng.uniform(math.log(0.02), math.log(99.0), 200)):
        found = find_margin(lambda level, most=threshold: level <= most, 1.0, 100.0)
        assert found.status == "found"
        assert found.margin <= threshold < found.fails_at <= (1 + PRECISION) * found.margin
        assert found.non_monotone == 0


def test_a_search_asks_for_each_level_once_and_tells_how_many():
    asked = []

    def stands(level):
        asked.append(level)
        return level < 7.3

    found = find_margin(stands, 1.0, 100.0)
    assert found.runs == len(asked) == len(set(asked))
    assert asked[:5] == [0.0, 1.0, 2.0, 4.0, 8.0]
    assert asked[-3:] == [part * found.margin for part in PROBES_BELOW]


def test_what_stands_the_cap_is_capped_and_what_stands_nothing_is_told_so():
    capped = find_margin(lambda _: True, 1.0, 100.0)
    assert (capped.status, capped.margin, capped.fails_at) == ("capped", 100.0, None)
    below = find_margin(lambda level: level == 0.0, 1.0, 100.0)
    assert (below.status, below.margin, below.fails_at) == ("below", 0.0, 1.0 / 2**HALVINGS)
    none = find_margin(lambda _: False, 1.0, 100.0)
    assert (none.status, none.margin, none.runs) == ("none", 0.0, 1)


def test_failures_below_the_margin_are_counted():
    found = find_margin(lambda level: level < 7.3 and not 5.0 < level < 5.5, 1.0, 100.0)
    assert found.status == "found"
    assert found.non_monotone == 1


def test_rows_are_asked_for_by_name_and_come_in_the_order_of_the_card():
    assert parse_rows(None) == tuple(ROWS)
    assert parse_rows("torque_limit, model") == ("model_above", "model_below", "torque_limit")
    with pytest.raises(MarginError, match=r"--rows delay,tork: tork: no such row; allowed: delay"):
        parse_rows("delay,tork")


def test_values_go_one_way_with_the_level():
    for row in ROWS.values():
        values = [row.value(level) for level in np.geomspace(row.start / 64, row.cap, 20)]
        steps = np.diff(values)
        assert (steps < 0).all() if row.smaller else (steps > 0).all()


def test_the_nominal_masses_change_and_nothing_else():
    scenario = load_scenario("paper_no_network")
    changed = ROWS["model_above"].changed(scenario, 0.5)
    path = nominal_model(scenario.controller)
    assert path == ("inversion", "effectiveness")
    assert changed.controller.inversion.effectiveness.masses == pytest.approx((1.5, 1.5 * 2.3))
    lighter = ROWS["model_below"].changed(changed, 1.0)  # of what it believed already
    assert lighter.controller.inversion.effectiveness.masses == pytest.approx((0.75, 0.75 * 2.3))
    assert changed.plant == scenario.plant
    assert ROWS["model_above"].changed(scenario, 0.0) is scenario


def test_the_torque_limit_shrinks_with_the_level():
    scenario = load_scenario("paper")
    assert ROWS["torque_limit"].changed(scenario, 1 / 80).imperfections.torque_limit == (80.0,)


def test_rows_put_their_value_where_a_scenario_has_it():
    scenario = load_scenario("paper", ["events=[{kind: push, at: 1, duration: 1, torque: [1, 0]}]"])

    def changed(row: str, level: float):
        found = ROWS[row].changed(scenario, level)
        assert found.controller == scenario.controller
        return found

    assert changed("delay", 0.0125).imperfections.actuator_delay == 0.0125  # s
    noise = changed("noise", 3.0).imperfections
    assert noise.position_noise == pytest.approx((3e-4,))  # rad
    assert noise.velocity_noise == pytest.approx((3e-3,))  # rad/s
    friction = changed("friction", 2.0).imperfections.friction
    assert (friction.coulomb, friction.viscous) == ((2.0,), (1.0,))
    push, payload = changed("payload", 1.2).events
    assert (push.kind, payload.kind, payload.at, payload.mass) == ("push", "payload", 0.0, 1.2)


def test_noise_of_a_velocity_from_angles_is_that_of_the_angles():
    scenario = load_scenario("paper", ["imperfections.velocity_from=difference"])
    found = ROWS["noise"].changed(scenario, 2.0).imperfections
    assert (found.position_noise, found.velocity_noise) == ((2e-4,), (0.0,))


@pytest.mark.parametrize("row", ROWS)
def test_more_of_every_imperfection_makes_another_motion(row):
    """Of the true arm, and up to the largest level that is ever asked for."""
    scenario = load_scenario("paper", ["duration=0.2"], controller="computed_torque")
    mjcf = Mjcf.read(find_model(scenario.plant.model))
    before = simulate(scenario, mjcf, watch=False)
    spec = ROWS[row]
    level = 1 / 40 if row == "torque_limit" else spec.start
    after = simulate(spec.changed(scenario, level), mjcf, watch=False)
    assert not np.array_equal(before["q"], after["q"])
    spec.changed(scenario, spec.cap)


def test_every_row_is_searched_on_a_real_arm():
    sets = ["duration=0.2", "controller.effectiveness.masses=[1.0, 2.3]"]
    scenario = load_scenario("paper", sets, controller="computed_torque")
    mjcf = Mjcf.read(find_model(scenario.plant.model))
    for name, spec in ROWS.items():
        (found,) = MarginTask(0, scenario, mjcf, name, 0.5, (1,))()
        assert found["status"] in {"found", "capped"}, (name, found)
        if found["status"] == "found" and not spec.smaller:
            assert found["margin"] < found["fails_at"] <= spec.at_cap


def test_what_no_scenario_can_have_is_refused_with_the_key():
    with pytest.raises(MarginError, match=r"torque_limit.*allowed"):
        ROWS["torque_limit"].changed(load_scenario("paper"), -1.0)


# Whether a kind is free of a model, with its defaults and with a constant B₂; None: it has none.
MODEL_FREE = {
    "dnn_mso": (False, True),
    "no_network": (False, True),
    "classical_mso": (False, None),
    "rbf_mso": (False, None),
    "lewis_nn": (True, None),
    "dnn_mso_replay": (False, True),
    "backstepping": (False, True),
    "slotine_li": (False, None),  # the form of the arm is its regressor
    "concurrent_learning": (False, None),
    "pd": (True, None),
    "pid": (True, None),
    "computed_torque": (False, None),
    "adrc": (False, True),
    "sliding_mode": (False, True),
    "rise": (True, None),
    "l1": (False, True),
}


def test_it_is_known_of_every_kind_whether_it_has_a_model():
    assert set(MODEL_FREE) == set(controller_kinds())


@pytest.mark.parametrize("kind", MODEL_FREE)
def test_no_masses_and_no_regressor_is_free_of_a_model(kind):
    default, constant = MODEL_FREE[kind]
    controller = load_scenario("paper", controller=kind).controller
    assert is_model_free(controller) is default
    above = "inversion." if hasattr(controller, "inversion") else ""
    sets = [f"controller.{above}effectiveness={{kind: constant}}"]
    if constant is None:
        with pytest.raises(ScenarioError):
            load_scenario("paper", sets, controller=kind)
    else:
        assert is_model_free(load_scenario("paper", sets, controller=kind).controller) is constant


def test_a_variant_is_a_file_like_any_other_controller(tmp_path):
    file = tmp_path / "no_network_constant.yaml"
    file.write_text(
        "controller: {kind: no_network, inversion: {effectiveness: {kind: constant, b: 0.5}}}\n"
    )
    names = [str(file), "no_network_tuned", "no_network"]
    plan = plan_margins("setpoint", names, ["model_above"], [0], HELD)
    assert model_free(plan) == (str(file),)
    assert plan.controllers[str(file)].controller.inversion.effectiveness.b == 0.5
    assert plan.controllers["no_network_tuned"].controller.inversion.K != (7.5,)


@pytest.fixture(scope="module")
def held() -> MarginPlan:
    return plan_margins("setpoint", ["no_network"], ["torque_limit", "model_above"], [0, 5], STIFF)


@pytest.fixture(scope="module")
def finished(held, tmp_path_factory):
    return run_margins(held, tmp_path_factory.mktemp("held") / "one.parquet", 1)


def test_the_smallest_torque_limit_is_the_static_gravity_load(finished):
    # G1 = (m1 + m2) g l1 + m2 g l2 with both links level; 0.02 rad of sag are allowed.
    load = (1.0 + 2.3) * 9.81 + 2.3 * 9.81
    row = next(row for row in finished.table.to_pylist() if row["row"] == "torque_limit")
    assert row["status"] == "found"
    assert row["fails_at"] < load
    assert row["margin"] > load * math.cos(0.02)
    assert row["margin"] <= (1 + PRECISION) * row["fails_at"]


def test_the_table_has_one_row_a_search_with_all_it_takes_to_make_it_again(held, finished):
    table = pq.read_table(finished.out)
    assert [(row["row"], row["seed"]) for row in table.to_pylist()] == [
        ("torque_limit", 0),
        ("torque_limit", 5),
        ("model_above", 0),
        ("model_above", 5),
    ]
    provenance = json.loads(table.schema.metadata[b"dnnmso_margins"])
    assert provenance["seeds"] == "0,5"
    assert provenance["definition"]["scenarios"]["no_network"]["controller"]["kind"] == "no_network"
    assert provenance["rows"]["torque_limit"]["cap"] == 1.0
    assert {"mujoco", "numpy"} <= provenance["software"].keys()


def test_two_workers_and_a_resumed_search_give_the_same_table(held, finished, tmp_path):
    out = tmp_path / "two.parquet"

    class Stop:
        def begin(self, total, kept):
            self.kept = kept

        def row(self, row):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_margins(held, out, 2, watcher=Stop())
    assert rows_in(journal_path(out)) == 1
    result = run_margins(held, out, 2, resume=True)
    assert result.kept == 1
    assert not journal_path(out).exists()
    assert result.table.drop_columns("wall_s") == finished.table.drop_columns("wall_s")


def test_another_limit_is_another_table(held, finished):
    before = finished.out.read_bytes()
    with pytest.raises(SweepError, match=r"limit: 0.02; now: 0.5"):
        run_margins(replace(held, limit=0.5), finished.out, 1, resume=True)
    with pytest.raises(SweepError, match="exists"):
        run_margins(held, finished.out, 1)
    assert finished.out.read_bytes() == before


def search(*sets: str, row: str = "torque_limit") -> dict:
    scenario = load_scenario("setpoint", ["controller={kind: no_network}", *sets])
    mjcf = Mjcf.read(find_model(scenario.plant.model))
    (found,) = MarginTask(0, scenario, mjcf, row, 0.02, (1,))()
    return found


def test_a_controller_that_fails_without_the_imperfection_has_no_margin():
    found = search(*HELD)  # with the paper's gains gravity is too much
    assert (found["status"], found["margin"], found["runs"]) == ("none", None, 1)
    assert found["reason"].startswith("rmse_steady = 0.")


def test_a_controller_without_a_model_has_none_to_be_wrong():
    found = search(*HELD, CONSTANT, row="model_below")
    assert (found["status"], found["reason"], found["ticks"]) == ("unused", "uses none", 0)


def test_a_search_that_raises_is_a_row_with_its_reason(held):
    cell = held.points[0]
    broken = replace(cell.mjcf, text="<mujoco/>")
    (row,) = MarginTask(0, cell.scenario, broken, "torque_limit", 0.02, (1,))()
    assert row["status"] == "failed"
    assert row["reason"].startswith("ScenarioError")


def hand_made(margins: dict[str, list[float | None]], row: str = "payload"):
    """A table of controllers' margins by hand, None for those that fail at once."""
    lines = [
        {
            "controller": name,
            "row": row,
            "seed": seed,
            "status": "none" if value is None else "found",
            "reason": "",
            "margin": value,
            "non_monotone": 0,
        }
        for name, values in margins.items()
        for seed, value in enumerate(values)
    ]
    spec = ROWS[row]
    definition = {
        "unit": spec.unit,
        "easiest": spec.value(spec.start / 2**HALVINGS),
        "cap": spec.at_cap,
        "better": "smaller" if spec.smaller else "larger",
    }
    names = list(margins)
    free = [name for name in names if name != "knows"]
    return pa.Table.from_pylist(lines), {
        "controllers": names,
        "model_free": free,
        "rows": {row: definition},
    }


def test_the_best_are_marked_among_those_without_a_model():
    table, provenance = hand_made(
        {
            "good": [2.0, 2.1, 2.2, 2.3, 2.4, 2.5, 2.6],
            "near": [1.9, 2.0, 2.1, 2.15, 2.2, 2.6, 2.7],
            "poor": [0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.21],
            "knows": [9.0, 9.0, 9.0, 9.0, 9.0, 9.0, 9.1],
            "fails": [None] * 7,
        }
    )
    lines = margins_of(table, provenance)
    ranking = rank(lines, provenance)["payload"]
    assert (ranking.best, ranking.within) == (("good",), ("near",))
    row = provenance["rows"]["payload"]
    texts = [cell_text(line, row, {"payload": ranking}) for line in lines]
    assert texts == ["2.3 **", "2.15 *", "0.2", "9", "none"]
    assert lines[-1].none == 7


def test_the_smaller_torque_limit_is_the_better_one():
    table, provenance = hand_made(
        {"weak": [60.0] * 3, "strong": [90.0] * 3, "half": [50.0, None, None]}, "torque_limit"
    )
    lines = margins_of(table, provenance)
    assert rank(lines, provenance)["torque_limit"].best == ("weak",)
    row = provenance["rows"]["torque_limit"]
    assert [value_text(line.spread.median, row) for line in lines] == ["60", "90", "none"]
    assert value_text(1.0, row) == "< 1"


def test_a_seed_without_a_margin_pulls_the_interval_down_to_none():
    table, provenance = hand_made({"a": [2.0, 2.1, 2.2, 2.3, None, None, None]})
    (line,) = margins_of(table, provenance)
    assert interval_text(line, provenance["rows"]["payload"]).startswith("none … 2")
    table, provenance = hand_made({"a": [51.2] * 7})
    (line,) = margins_of(table, provenance)
    assert interval_text(line, provenance["rows"]["payload"]) == "> 51.2"


def test_a_seed_that_fails_at_once_is_told_once_for_all_its_rows():
    one, _ = hand_made({"a": [2.0, None]}, "payload")
    other, _ = hand_made({"a": [2.0, None]}, "noise")
    (found,) = unfound(pa.concat_tables([one, other]))
    assert (found.controller, found.seed, found.rows) == ("a", 1, ("payload", "noise"))


def test_controllers_are_told_apart_by_what_they_know():
    plan = plan_margins(
        "setpoint", ["no_network"], ["model_above"], [0], (*HELD, CONSTANT), limit=0.5
    )
    assert model_free(plan) == ("no_network",)
    with pytest.raises(MarginError, match=r"--controllers: no_network is there twice"):
        plan_margins("setpoint", ["no_network", "no_network"], ["model_above"], [0])


def test_the_command_prints_cards_a_matrix_and_where_the_table_is(tmp_path: Path):
    sets = [word for text in (*HELD, "duration=0.2") for word in ("--set", text)]
    common = ("margins", "setpoint", "--controllers", "no_network", "--seeds", "0:2", *sets)
    rows = ("--rows", "torque_limit", "--limit", "0.1")
    shown = dnnmso(*common, *rows, cwd=tmp_path)
    assert shown.returncode == 0, shown.stderr
    for text in ("margin card of no_network", "torque_limit", "no_network †", "margins.parquet"):
        assert text in shown.stdout
    done = dnnmso(*common, *rows, "--resume", "--json", cwd=tmp_path)
    document = json.loads(done.stdout)
    assert document["rows_kept"] == document["rows"] == 2
    assert document["margins"][0]["spread"]["n"] == 2


def test_bad_input_is_one_message_and_status_2(tmp_path: Path):
    common = ("margins", "setpoint", "--seeds", "0:2", "--controllers")
    for words in (
        (*common, "nobody"),
        (*common, "no_network", "--rows", "wind"),
        (*common, "no_network,"),
        (*common, "no_network", "--limit", "nan"),
    ):
        done = dnnmso(*words, cwd=tmp_path)
        assert done.returncode == 2
        assert done.stderr.startswith("error: --")
        assert "allowed" in done.stderr
        assert "Traceback" not in done.stderr
    assert not list(tmp_path.rglob("*.parquet*"))
