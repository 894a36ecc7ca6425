"""The learning audit: its numbers in closed form, and what it finds of models that are known."""

from __future__ import annotations

import io
import json
import math
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.collections import QuadMesh
from PIL import Image

from dnnmso_mj.audit.drift import learned_drift, true_drift
from dnnmso_mj.audit.figure import audit_figure, audit_png
from dnnmso_mj.audit.frozen import other_trajectory, same_trajectory, window, without_model
from dnnmso_mj.audit.knowledge import knowledge
from dnnmso_mj.audit.plan import AuditError, AuditPlan, plan_audit
from dnnmso_mj.audit.region import distance_to_hull, region_of
from dnnmso_mj.audit.run import Examination, gather
from dnnmso_mj.audit.subject import Questions, Subject, examine
from dnnmso_mj.audit.summary import MEASURES, summarise
from dnnmso_mj.audit.unseen import SETTLING, SPAN, reference_states, unseen_trajectories
from dnnmso_mj.dynamics import TwoLink
from dnnmso_mj.errors import NonFiniteError
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.scenario import Scenario, Sinusoid
from dnnmso_mj.simulation import Simulation, simulate

COARSE = {"dt": 0.005}  # s; a fifth of the ticks
AT = 3.0  # s
ARM = TwoLink((1.0, 2.3), (1.0, 1.0))
EXACT = {
    "kind": "classical_mso",
    "network": {"hidden": (4,), "output_scale": 1e-3},
    "madam": {"eta": 1e-6, "eta_max": 1e-6},
}


@pytest.fixture(scope="module")
def circle():
    """The region of q = (sin, cos), q̇ = (cos, -sin)."""
    t = np.linspace(0.0, 2.0 * math.pi, 500)
    return region_of(np.column_stack([np.sin(t), np.cos(t), np.cos(t), -np.sin(t)]))


@pytest.fixture(scope="module")
def questions(circle) -> Questions:
    """Few of them, of the paper's trajectory."""
    t = np.linspace(0.0, 13.0, 500)
    reference = Sinusoid(kind="sinusoid", frequency=0.5, phase=(0.0, math.pi / 2))
    region = region_of(reference_states(reference, 2, t))
    some = {"reversed", "move", "larger"}
    rng = np.random.default_rng(0)
    return Questions(
        at=(AT,),
        region=region,
        unseen=tuple(one for one in unseen_trajectories(region) if one.name in some),
        near=region.draw_inside(50, rng),
        outside=region.draw_outside(50, rng),
    )


@pytest.fixture(scope="module")
def audited(make_scenario, two_link, questions):
    """One row each of a controller that knows all, one that knows nothing, and the paper's."""

    def row(controller, **parts):
        subject = Subject("x", make_scenario(controller, **COARSE, **parts), two_link)
        return examine(subject, questions, 0, draw=True)

    return SimpleNamespace(
        exact=row(EXACT), nothing=row({"kind": "no_network"}), paper=row({"kind": "dnn_mso"})
    )


def test_knowledge_is_one_of_the_truth_zero_of_nothing_and_negative_of_what_is_worse():
    f = np.random.default_rng(1).normal(size=(30, 2))
    assert knowledge(f, f) == 1.0
    assert knowledge(f, np.zeros_like(f)) == 0.0
    assert knowledge(f, 0.75 * f) == pytest.approx(0.75)
    assert knowledge(f, 1.25 * f) == pytest.approx(0.75)
    assert knowledge(f, -f) == pytest.approx(-1.0)
    assert knowledge(f, 5.0 * f) == pytest.approx(-3.0)


def test_knowledge_of_an_offset_is_one_less_its_share():
    f = np.array([[3.0, 4.0], [-3.0, -4.0]])  # RMS sqrt(12.5)
    assert knowledge(f, f + 1.0) == pytest.approx(1.0 - 1.0 / math.sqrt(12.5))


def test_knowledge_has_no_unit_and_no_range():
    f, g = np.random.default_rng(2).normal(size=(2, 30, 2))
    assert knowledge(1e200 * f, 1e200 * g) == pytest.approx(knowledge(f, g))
    assert knowledge(1e-200 * f, 1e-200 * g) == pytest.approx(knowledge(f, g))


def test_where_there_is_nothing_to_know_there_is_no_number():
    assert knowledge(np.zeros((3, 2)), np.ones((3, 2))) is None
    with pytest.raises(NonFiniteError, match="f_hat = nan"):
        knowledge(np.ones((3, 2)), np.full((3, 2), np.nan))


def test_distance_to_a_hull_is_that_to_its_nearest_point():
    square = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    for point, distance in [((0, 0), 0), ((1, 0.5), 0), ((3, 0), 2), ((2, 2), math.sqrt(2))]:
        assert distance_to_hull(np.array(point, float), square) == pytest.approx(distance, abs=1e-6)
    flat = np.array([[0.0, 0.0], [1.0, 0.0]])
    assert distance_to_hull(np.array([0.5, 0.3]), flat) == pytest.approx(0.3, abs=1e-6)


def test_a_circle_holds_its_disc_at_its_speeds_and_no_more(circle):
    assert circle.centre == pytest.approx(np.zeros(4), abs=1e-4)
    assert circle.half == pytest.approx(np.ones(4), abs=1e-4)
    inside = [[0, 0, 0, 0], [0.7, 0.7, 0, 0], [0, 0.99, 1, -1]]
    beyond = [[0.8, 0.8, 0, 0], [0, 1.1, 0, 0], [0, 0, 1.1, 0], [0, 0, 0, -1.1]]
    assert circle.contains(np.array([*inside, *beyond], float)).tolist() == [True] * 3 + [False] * 4


def test_states_are_drawn_where_they_should_be(circle):
    rng = np.random.default_rng(3)
    near, outside = circle.draw_inside(300, rng), circle.draw_outside(300, rng)
    assert circle.contains(near).all()
    assert not circle.contains(outside).any()
    assert np.abs(near).max(axis=0).min() > 0.8  # all of it, not its middle alone
    assert 1.9 < np.abs(outside).max() <= 2.0 + 1e-3


def test_a_joint_at_rest_leaves_a_region_of_some_width():
    region = region_of(np.tile([0.3, -0.2, 0.0, 0.0], (10, 1)))
    assert region.half.tolist() == [0.1] * 4
    assert region.contains(region.middle[None]).all()
    assert not region.contains(np.array([[0.5, -0.2, 0.0, 0.0]])).any()


def test_unseen_trajectories_are_inside_or_beyond_as_they_say(circle):
    unseen = unseen_trajectories(circle)
    assert len([one for one in unseen if one.inside]) == 6
    assert len([one for one in unseen if not one.inside]) == 3
    times = np.random.default_rng(4).uniform(0.0, SPAN, 200)
    for one in unseen:
        share = circle.contains(reference_states(one.reference, 2, times)).mean()
        assert share > 0.99 if one.inside else share < 0.5, one.name


def test_what_has_no_room_inside_is_left_out():
    line = np.linspace(0.0, 1.0, 100)
    region = region_of(np.column_stack([line, line, 0.0 * line + 0.5, 0.0 * line + 0.5]))
    names = {one.name for one in unseen_trajectories(region) if one.inside}
    assert "smaller" not in names
    assert {"in phase", "move"} <= names


def test_true_drift_is_the_formula(make_scenario, two_link):
    simulation = Simulation(make_scenario(), two_link)
    states = np.random.default_rng(5).uniform(-3.0, 3.0, size=(50, 4))
    before = simulation.plant.q.copy()
    found = true_drift(simulation.plant, states)
    formula = ARM.acceleration(states[:, :2], states[:, 2:], np.zeros(2))
    assert found == pytest.approx(formula, abs=1e-9)
    assert simulation.plant.q == pytest.approx(before)


def test_asking_a_controller_changes_nothing(make_scenario, two_link):
    scenario = make_scenario(duration=0.5)
    asked = Simulation(scenario, two_link)
    learned_drift(asked.controller, np.ones((5, 4)))
    recorder = MemoryRecorder(asked.layout, scenario.n_ticks)
    trace = recorder.trace(scenario, asked.run(recorder))
    assert np.array_equal(trace["q"], simulate(scenario, two_link)["q"])


def test_a_perfect_model_knows_all_and_needs_no_learning(audited):
    row = audited.exact.rows[0]
    for where in ("visited", "near", "outside"):
        assert row[f"knowledge_{where}"] > 0.99
    for name in ("same_alone", "same_fed", "inside", "outside"):
        assert row[name] < 0.05 * row["same_none"], name
    assert row["diverged"] == []


def test_no_network_knows_nothing_and_is_its_own_yardstick(audited):
    row = audited.nothing.rows[0]
    for where in ("visited", "near", "outside"):
        assert row[f"knowledge_{where}"] == 0.0
    for name in ("inside", "outside"):
        assert row[name] == row[f"{name}_none"] > 0.05
    assert row["same_alone"] == row["same_fed"] == row["same_none"]


def test_the_papers_network_adapts_fast_and_knows_little(audited, make_scenario, two_link):
    row = audited.paper.rows[0]
    assert row["knowledge_near"] < 0.6
    learning = simulate(make_scenario(**COARSE, duration=AT + 10.0), two_link, watch=False)
    steady = (learning["q"] - learning["q_ref"])[round(AT / 0.005) :]
    assert row["same_alone"] > 10.0 * np.sqrt(np.mean(steady**2))


def test_weights_stay_to_the_last_bit_once_they_are_frozen(make_scenario, two_link):
    scenario = same_trajectory(make_scenario(**COARSE), 1.0, "all")
    simulation, kept = Simulation(scenario, two_link), {}

    class Keep(MemoryRecorder):
        keeps_snapshots = True

        def snapshot(self, name, t, arrays):
            if name == "controller":
                kept[round(t, 6)] = arrays

    simulation.run(Keep(simulation.layout, scenario.n_ticks))
    first, frozen, last = kept[0.0], kept[1.0], kept[round(scenario.duration, 6)]
    assert scenario.duration == pytest.approx(1.0 + window(scenario))
    assert not np.array_equal(first["weights"], frozen["weights"])
    for name in ("weights", "second_moment", "updates"):
        assert np.array_equal(frozen[name], last[name])


def test_another_trajectory_begins_on_its_reference_with_the_learned_weights(
    make_scenario, two_link, questions, audited
):
    scenario = make_scenario(**COARSE, duration=AT)
    learned = Simulation(scenario, two_link, watch=False)
    learned.run(MemoryRecorder(learned.layout, scenario.n_ticks))
    state = learned.controller.state()
    unseen = questions.unseen[0]
    elsewhere = other_trajectory(scenario, AT, unseen)
    simulation = Simulation(elsewhere, two_link, watch=False)
    simulation.controller.restore(state)
    recorder = MemoryRecorder(simulation.layout, elsewhere.n_ticks)
    trace = recorder.trace(elsewhere, simulation.run(recorder))
    assert trace["q"][0] == pytest.approx(trace["q_ref"][0])
    assert trace["qd"][0] == pytest.approx(trace["qd_ref"][0])
    assert not trace["e_obs"][0].any()
    assert np.array_equal(simulation.controller.state()["weights"], state["weights"])
    error = (trace["q"] - trace["q_ref"])[round(SETTLING / scenario.dt) :]
    found = audited.paper.rows[0]["trajectories"][unseen.name]["frozen"]
    assert found == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-12)


def test_the_audit_puts_its_own_freeze_in_the_place_of_others(make_scenario):
    early = make_scenario(events=({"kind": "freeze", "at": 0.5, "what": "all"},))
    events = same_trajectory(early, 2.0, "model").events
    assert [(event.at, event.what) for event in events] == [(2.0, "model")]


def test_the_plant_stays_what_it_is_at_the_freeze(make_scenario, two_link, questions):
    events = (
        {"kind": "payload", "at": 0.5, "mass": 1.2},
        {"kind": "push", "at": 0.7, "duration": 0.1, "torque": (5.0,)},
        {"kind": "payload", "at": 4.0, "mass": -1.2},
    )
    scenario = same_trajectory(make_scenario(**COARSE, events=events), 2.0, "all")
    assert [event.kind for event in scenario.events] == ["payload", "push", "freeze"]
    elsewhere = other_trajectory(make_scenario(**COARSE, events=events), 2.0, questions.unseen[0])
    assert [(e.kind, e.at) for e in elsewhere.events] == [("payload", 0.0), ("freeze", 0.0)]
    loaded = TwoLink((1.0, 3.5), (1.0, 1.0))
    states = np.random.default_rng(6).uniform(-1.0, 1.0, size=(5, 4))
    formula = loaded.acceleration(states[:, :2], states[:, 2:], np.zeros(2))
    for changed in (scenario, elsewhere):
        simulation = Simulation(changed, two_link)
        simulation.run(MemoryRecorder(simulation.layout, changed.n_ticks))
        assert true_drift(simulation.plant, states) == pytest.approx(formula)


def test_the_yardstick_has_the_controllers_gains_and_no_model(make_scenario):
    scenario = make_scenario({"kind": "dnn_mso", "inversion": {"K": 5.0, "lam": 3.0}})
    bare = without_model(scenario)
    assert bare.controller.kind == "no_network"
    assert bare.controller.inversion == scenario.controller.inversion
    assert bare.reference == scenario.reference


@pytest.mark.parametrize(("frequency", "length"), [(0.5, 4 * math.pi), (0.1, 20.0), (9.0, 10.0)])
def test_the_arm_goes_on_for_a_period_within_reason(make_scenario, frequency, length):
    scenario = make_scenario(reference={"kind": "sinusoid", "frequency": frequency})
    assert window(scenario) == pytest.approx(length, abs=scenario.dt)


def test_a_run_that_diverges_is_counted_and_has_no_number(make_scenario, two_link, questions):
    unstable = {"kind": "dnn_mso", "observer": {"K2": 300.0, "feedback": "as_printed"}}
    subject = Subject("printed", make_scenario(unstable), two_link)
    found = examine(subject, questions, 0, draw=True)
    row = found.rows[0]
    assert {"same_alone", "same_fed"} <= set(row["diverged"])
    assert "x_hat" in row["reason"]
    assert [row[name] for name in MEASURES] == [None] * len(MEASURES)
    assert found.portrait is None
    point = summarise(found.rows, ["printed"], [AT])[0]
    assert (point.runs, point.diverged, point.measures["same_alone"].n) == (1, 1, 0)


def test_an_examination_that_breaks_off_is_a_row_with_its_reason(two_link, questions):
    broken = Subject("x", Scenario.model_construct(), two_link)
    row = next(Examination(4, broken, questions, (7,), 7)())
    assert (row["point"], row["seed"], row["status"]) == (4, 7, "failed")
    assert row["reason"]


def test_the_figure_has_every_map_and_the_visited_states_on_it(
    audited, questions, make_scenario, two_link
):
    subjects = tuple(Subject(name, make_scenario(), two_link) for name in ("x",))
    row = {"point": 0, "seed": 0, "status": "ok", "findings": audited.paper}
    audit = gather(AuditPlan(subjects, questions, (0,)), [row], 1.0)
    maps = [
        axes
        for axes in audit_figure(audit).get_axes()
        if any(isinstance(part, QuadMesh) for part in axes.collections) and axes.lines
    ]
    assert len(maps) == 6
    visited = audit.portraits[0].visited
    drawn = maps[0].lines[-1].get_xydata()
    assert np.array_equal(drawn, visited[:, :2])
    true = next(part for part in maps[0].collections if isinstance(part, QuadMesh)).get_array()
    assert np.array_equal(np.ravel(true), audit.portraits[0].slices[0].f_true[..., 0].ravel())
    picture = np.asarray(Image.open(io.BytesIO(audit_png(audit))).convert("RGB"))
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 500
    assert min(picture.shape[:2]) > 600


def test_a_map_is_of_the_state_that_its_axes_say(audited):
    cut = audited.exact.portrait.slices[0]
    q = np.array([cut.x[5], cut.y[20]])
    assert cut.f_true[20, 5] == pytest.approx(ARM.acceleration(q, np.zeros(2), np.zeros(2)))


REFUSALS = [
    ({"at": [0.0]}, "--at 0: no tick is before it"),
    ({"at": [math.nan]}, "--at nan"),
    ({"controllers": ["dnn_mso", "dnn_mso"]}, "dnn_mso is there twice"),
    ({"sets": ["seed=3"]}, "--seeds"),
]


@pytest.mark.parametrize(("asked", "message"), REFUSALS)
def test_what_cannot_be_audited_is_refused(asked, message):
    with pytest.raises(AuditError, match=message):
        plan_audit("paper", **{"controllers": [], "at": [1.0], "seeds": [0], **asked})


def dnnmso(*args: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "dnnmso_mj", "audit", *args]
    return subprocess.run(
        command, cwd=cwd, capture_output=True, text=True, check=False, timeout=120
    )


def test_the_command_leaves_one_figure_one_file_and_one_table(tmp_path):
    args = ("paper", "--controllers", "no_network,classical_mso", "--at", "1,2", "--seeds", "0:2")
    done = dnnmso(*args, "--set", "dt=0.01", "--out", "here", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert sorted(path.name for path in (tmp_path / "here").iterdir()) == [
        "audit_paper.json",
        "audit_paper.png",
    ]
    assert max(map(len, done.stdout.splitlines())) <= 80
    for words in ("no_network", "classical_mso", "at 2 s", "knowledge, visited", "0 of 2"):
        assert words in done.stdout
    document = json.loads((tmp_path / "here" / "audit_paper.json").read_text())
    assert (document["at"], document["seeds"]) == ([1.0, 2.0], [0, 1])
    assert len(document["points"]) == 4
    assert len(document["rows"]) == 8
    assert set(document["points"][0]["measures"]) == set(MEASURES)
    assert document["points"][0]["measures"]["knowledge_visited"]["median"] == 0.0


def test_json_is_one_object_and_bad_input_is_one_line(tmp_path):
    done = dnnmso("paper", "--at", "1", "--seeds", "3", "--set", "dt=0.01", "--json", cwd=tmp_path)
    document = json.loads(done.stdout)
    assert document["rows"][0]["seed"] == 3
    assert [Path(file).parent for file in document["files"]] == [tmp_path / "logs"] * 2
    bad = dnnmso("paper", "--at", "soon", cwd=tmp_path)
    assert (bad.returncode, bad.stdout) == (2, "")
    assert "--at 'soon'" in bad.stderr
    assert len(bad.stderr.splitlines()) == 1
