"""Going on from a log: as it was, to the last bit, or with something changed from a tick on."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from outside_samples import LAWS
from policy_samples import SOURCE
from resume_samples import SCENARIOS

from dnnmso_mj.branching import _refill
from dnnmso_mj.difference import difference
from dnnmso_mj.errors import DnnmsoError, LogError, RunInterrupted, ScenarioError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.log.format import scenario_record
from dnnmso_mj.log.prefix import Prefix, copy
from dnnmso_mj.log.writer import LogWriter
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.reading import log_info, read_snapshots, read_trace
from dnnmso_mj.recorded import read_recorded
from dnnmso_mj.resume import Resumed, resume
from dnnmso_mj.run import run_logged
from dnnmso_mj.simulation import Simulation, simulate
from dnnmso_mj.trace import Trace

ROOT = Path(__file__).parents[1]
COUNT = 50
CLOCKED = {"compute_us", "wake_late_us"}
PD = ["controller={kind: pd}", "duration=1.4"]
PID = ["controller={kind: pid}", "duration=0.6"]


def log_of(folder: Path, sets: Sequence[str], name: str = "run") -> Path:
    return run_logged(load_scenario("paper", sets), folder / f"{name}.mcap").log


@pytest.fixture(scope="module")
def pd(tmp_path_factory) -> Path:
    """A run of a controller without memory; it is compiled soon."""
    return log_of(tmp_path_factory.mktemp("pd"), PD)


@pytest.fixture(scope="module")
def learning(tmp_path_factory) -> Path:
    return log_of(tmp_path_factory.mktemp("learning"), ["duration=0.5"])


def on(log: Path, at: float, *sets: str, name: str = "next") -> Resumed:
    return resume(log, at, sets, log.with_name(f"{name}.mcap"), force=True)


def check_same(one: Trace, other: Trace, first: int = 0, last: int | None = None) -> None:
    for name in set(one) - CLOCKED:
        assert np.array_equal(one[name][first:last], other[name][first:last]), name


def weights(log: Path) -> list[np.ndarray]:
    """At every snapshot."""
    return [s.arrays["weights"] for s in read_snapshots(log) if s.name == "controller"]


@pytest.mark.parametrize("name", SCENARIOS)
def test_from_random_ticks_of_its_log_alone_a_run_goes_on_bit_for_bit(name, tmp_path):
    model, file, log = (tmp_path / f"{name}{suffix}" for suffix in (".xml", ".yaml", ".mcap"))
    model.write_text((ROOT / "models" / "two_link.xml").read_text())
    file.write_text(SCENARIOS[name].replace("MODEL", model.name))
    run = [sys.executable, "-m", "dnnmso_mj", "run", str(file), "--out", str(log), "--no-plot"]
    subprocess.run(run, check=True, capture_output=True)
    model.unlink()
    file.unlink()
    program = [sys.executable, str(ROOT / "tests" / "resume_samples.py"), str(log), "5", str(COUNT)]
    done = subprocess.run(program, check=True, capture_output=True, text=True)
    assert done.stdout == f"{COUNT} ticks\n"


def test_a_log_resumed_with_nothing_changed_is_the_same_log(pd):
    done = on(pd, 1.217)
    assert (done.tick, done.checked, done.told) == (1217, 217, "")
    assert difference(pd, done.run.log).equal
    assert dict(log_info(done.run.log).resumed) == {
        "source": "run.mcap",
        "at": "1.217",
        "sets": "[]",
    }
    metrics = (dict(log_info(log).metrics) for log in (pd, done.run.log))
    one, other = ({k: v for k, v in m.items() if "compute" not in k} for m in metrics)
    assert one == other
    assert log_info(done.run.log).status == "ok"


@pytest.mark.parametrize("at", [0.0, 0.001, 1.0, 1.399, 1.4])
def test_the_first_and_the_last_tick_and_a_snapshot_are_as_good_as_any(pd, at):
    assert difference(pd, on(pd, at).run.log).equal


def test_who_keeps_no_snapshots_pays_for_none(two_link):
    simulation = Simulation(load_scenario("paper", PD), two_link)
    kept = []
    state = simulation.stage.state
    simulation.stage.state = lambda: kept.append(1) or state()
    recorder = MemoryRecorder(simulation.layout, simulation.scenario.n_ticks)
    simulation.run(recorder)
    assert not kept


def test_the_time_is_that_of_the_nearest_tick(pd):
    assert on(pd, 0.30049).tick == 300
    assert on(pd, 0.3006).tick == 301


@pytest.mark.parametrize(
    "event",
    [
        "{kind: payload, at: 0.317, mass: 0.8}",
        "{kind: push, at: 0.317, duration: 0.2, torque: [6.0, 0.0], force: [0.0, 9.0]}",
        "{kind: freeze, at: 0.317, what: model}",
    ],
)
def test_a_branch_with_an_event_is_the_run_that_had_it_from_the_start(learning, event):
    expected = simulate(load_scenario("paper", ["duration=0.5", f"events=[{event}]"]))
    done = on(learning, 0.317, f"events=[{event}]")
    check_same(done.run.trace, expected)
    told = [e.message for e in done.run.trace.events if e.t == 0.317]
    assert (
        told[0] == f"resumed from run.mcap with events=[{event}]; the controller goes on as it is"
    )
    assert told[1] == expected.events[0].message


def test_events_of_the_new_scenario_that_were_before_are_in_force(pd):
    one, other = (
        on(pd, 0.5, f"events=[{{kind: payload, at: {at}, mass: 0.8}}]", name=f"payload-{at}")
        for at in (0.1, 0.5)
    )
    check_same(one.run.trace, other.run.trace)


def test_a_push_that_is_taken_away_ends_there(tmp_path):
    """As one that ends there: it is gone, and what it did in the last period is accounted for."""
    push = "events=[{{kind: push, at: 0.1, duration: {}, torque: [9.0, 9.0]}}]"
    log = log_of(tmp_path, ["controller={kind: no_network}", "duration=0.4", push.format(0.3)])
    gone, ended = on(log, 0.3, "events=[]", name="gone"), on(log, 0.3, push.format(0.2), name="end")
    check_same(gone.run.trace, ended.run.trace)
    assert difference(gone.run.log, on(gone.run.log, 0.301, name="again").run.log).equal


def test_frozen_weights_stay(learning):
    done = on(learning, 0.317, "events=[{kind: freeze, at: 0.317, what: model}]")
    first, branch, last = weights(done.run.log)
    assert (first != branch).any()
    assert np.array_equal(branch, last)


def test_another_controller_begins_anew_and_columns_that_it_has_not_are_zero(learning):
    done = on(learning, 0.2, "controller={from: pd_tuned}")
    trace, before = done.run.trace, read_trace(learning)
    check_same(trace, before, last=200)
    assert "begins anew: it was dnn_mso, and is pd" in done.told
    assert trace.n_layers == 4
    assert (trace["weight_norm"][:200] > 0).all()
    assert not trace["weight_norm"][200:].any()
    spec = trace.scenario.controller
    e, ed = trace["q"] - trace["q_ref"], trace["qd"] - trace["qd_ref"]
    assert np.allclose(trace["tau_cmd"][200:], -(spec.kp * e + spec.kd * ed)[200:])
    assert np.array_equal(trace["q"][200], before["q"][200])


def test_a_network_may_take_over_from_what_has_none(pd):
    done = on(pd, 0.3, "controller={kind: dnn_mso}", "duration=0.4")
    trace = done.run.trace
    assert not trace["weight_norm"][:300].any()
    assert (trace["weight_norm"][300:] > 0).all()
    assert np.array_equal(
        trace["x_hat"][300], trace["q_meas"][300].tolist() + trace["qd_meas"][300].tolist()
    )
    assert difference(done.run.log, on(done.run.log, 0.35, name="again").run.log).equal


def test_a_changed_gain_keeps_what_the_controller_knows(tmp_path):
    log = log_of(tmp_path, PID)
    integral = read_snapshots(log)[-2].arrays["integral"]
    changed = on(log, 0.6, "controller.kp=150", "duration=0.7")
    assert changed.told.endswith("the controller goes on as it is")
    at_branch = next(s for s in read_snapshots(changed.run.log) if s.t == 0.6)
    assert np.array_equal(at_branch.arrays["integral"], integral)
    assert integral.any()


def test_a_controller_of_another_shape_begins_anew(learning):
    done = on(learning, 0.3, "controller.network.hidden=[16, 16]", "duration=0.31")
    assert "begins anew: eta_bound had (4,) entries and has (3,)" in done.told


def test_another_plant_keeps_the_arm_where_it_is(pd):
    trace, before = on(pd, 0.3, "plant.gravity=1.62").run.trace, read_trace(pd)
    for name in ("q", "qd", "tau_cmd"):
        assert np.array_equal(trace[name][:301], before[name][:301])
    assert (trace["qd"][301] != before["qd"][301]).all()


def test_a_delay_begins_with_the_torque_that_acts(pd):
    trace = on(pd, 0.3, "imperfections.actuator_delay=0.01").run.trace
    assert (trace["tau"][300:310] == trace["tau"][299]).all()
    assert np.array_equal(trace["tau"][310:330], trace["tau_cmd"][300:320])


def test_what_is_on_its_way_stays_so_where_a_delay_changes(pd):
    delayed = on(pd, 0.3, "imperfections.actuator_delay=0.01", name="delayed").run.log
    for delay in (4, 15):
        trace = on(delayed, 0.4, f"imperfections.actuator_delay={delay / 1000}").run.trace
        wait = min(delay, 10)
        late = trace["tau_cmd"][400 - wait : 400]
        assert np.array_equal(trace["tau"][400 + delay - wait : 400 + delay], late)


def test_a_late_sensor_begins_with_the_present(pd):
    trace = on(pd, 0.3, "imperfections.sensor_delay=0.005").run.trace
    assert np.array_equal(trace["q_meas"][300:306], np.tile(trace["q"][300], (6, 1)))
    assert np.array_equal(trace["q_meas"][306:320], trace["q"][301:315])


def test_a_velocity_made_of_differences_begins_with_the_one_there_is(pd):
    trace = on(pd, 0.3, "imperfections.velocity_from=difference").run.trace
    assert np.allclose(trace["qd_meas"][300:310], trace["qd"][300:310], atol=0.1)


def test_a_ring_of_another_size_holds_the_same_past():
    ticks = np.arange(7, 12)  # the last five before tick 12
    ring = np.empty((5, 1))
    ring[ticks % 5, 0] = ticks
    assert np.array_equal(_refill(ring, 5, 12), ring)
    short, long = _refill(ring, 3, 12), _refill(ring, 8, 12)
    assert [short[k % 3, 0] for k in (9, 10, 11)] == [9, 10, 11]
    assert [long[k % 8, 0] for k in range(4, 12)] == [7, 7, 7, 7, 8, 9, 10, 11]


def test_a_bound_of_another_law_begins_at_the_present_error_and_holds(tmp_path):
    log = log_of(tmp_path, ["controller={kind: no_network}", "duration=0.6"])
    for changed in ("controller.inversion.K=9", "reference.offset=0.1"):
        trace = on(log, 0.3, changed).run.trace
        e, ed = trace["q"] - trace["q_ref"], trace["qd"] - trace["qd_ref"]
        bound, paper = trace["ultimate_bound"], trace["ultimate_bound_paper"]
        assert (np.abs(e).max(axis=1)[300:] <= bound[300:]).all()
        assert bound[300] < 1.5 * np.linalg.norm(e[300])
        assert paper[300] == pytest.approx(np.linalg.norm([e[300], ed[300]]), rel=1e-12)


def test_a_longer_run_goes_on_where_the_shorter_one_ended(pd):
    longer = simulate(load_scenario("paper", [PD[0], "duration=1.6"]))
    check_same(on(pd, 1.4, "duration=1.6").run.trace, longer)


def test_a_resumed_log_is_resumed_again_before_at_and_after_its_branch(pd):
    branched = on(pd, 0.517, "controller.kp=90", name="branched").run.log
    for at in (0.517, 0.518, 0.9, 1.2):
        assert difference(branched, on(branched, at).run.log).equal
    # Before its branch, what was in force then goes on.
    assert difference(pd, on(branched, 0.516).run.log).equal
    twice = on(branched, 0.8, "plant.gravity=5", name="twice").run.log
    assert [part.first for part in read_recorded(twice).segments] == [0, 517, 800]
    assert difference(branched, on(twice, 0.7).run.log).equal
    assert difference(twice, on(twice, 1.1).run.log).equal


def test_another_model_is_kept_in_the_log_and_so_is_the_one_before(tmp_path):
    """Its mesh too: a log alone is gone on from."""
    shape = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    text = (ROOT / "models" / "two_link.xml").read_text()
    # Without a name of its own it has its file's.
    mesh = '<asset><mesh file="hand.obj" inertia="legacy"/></asset><worldbody>'
    geom = '<geom name="hand" type="mesh" mesh="hand" mass="0"/><site name="tip"'
    folder = tmp_path / "arms"
    (folder / "parts").mkdir(parents=True)
    (folder / "parts" / "hand.obj").write_text(shape)
    text = text.replace("<worldbody>", mesh, 1).replace('<site name="tip"', geom)
    (folder / "arm.xml").write_text(text.replace("<compiler", '<compiler meshdir="parts"'))
    assert 'meshdir="parts"' in (folder / "arm.xml").read_text()
    pd = log_of(tmp_path, [PD[0], "duration=0.3"])
    done = on(pd, 0.1, f"plant.model={folder / 'arm.xml'}", name="other").run.log
    for file in (folder / "arm.xml", folder / "parts" / "hand.obj"):
        file.unlink()
    assert set(read_recorded(done).files) == {"model.xml", "model-0.xml", "asset/parts/hand.obj"}
    again = on(done, 0.2, name="again").run.log
    assert difference(done, again).equal
    assert difference(again, on(again, 0.15).run.log).equal
    assert difference(pd, on(again, 0.05).run.log).equal


def test_a_model_that_is_named_again_is_the_file_as_it_is_now(tmp_path):
    file = tmp_path / "arm.xml"
    text = (ROOT / "models" / "two_link.xml").read_text()
    file.write_text(text)
    log = log_of(tmp_path, [PD[0], f"plant.model={file}", "duration=0.3"])
    same = on(log, 0.1, f"plant.model={file}", name="same").run.log
    assert difference(log, same).equal
    file.write_text(text.replace('model="two_link"', 'model="renamed"'))
    assert file.read_text() != text
    other = difference(log, on(log, 0.1, f"plant.model={file}", name="other").run.log)
    assert set(other.files) == {"model.xml", "model-0.xml"}
    assert not other.equal
    assert not other.columns
    assert difference(log, on(log, 0.1, name="own").run.log).equal


def test_code_from_outside_goes_on_too_if_it_is_trusted(tmp_path):
    (tmp_path / "laws.py").write_text(LAWS)
    sets = [
        f"controller={{kind: external, python: '{tmp_path}/laws.py:Remembers'}}",
        f"imperfections.external=[{{python: '{tmp_path}/laws.py:Noisy'}}]",
        "duration=1.1",
    ]
    log = run_logged(load_scenario("paper", sets, trust=True), tmp_path / "run.mcap").log
    for at in (0.3, 1.05):
        again = resume(log, at, out=tmp_path / "again.mcap", force=True, trust=True).run.log
        assert difference(log, again).equal
    with pytest.raises(ScenarioError, match=r"its scenario: controller\.python = .*--trust"):
        resume(log, 0.3, ["controller={kind: pd}"])
    other = "controller.settings={}"
    assert resume(log, 0.3, [other], trust=True).told == ""
    gone = resume(log, 0.3, ["imperfections.external=[]"], trust=True).run.trace
    assert np.array_equal(gone["q_meas"][300:], gone["q"][300:])


@pytest.mark.parametrize("name", ["Slotted", "Frozen"])
def test_what_a_law_remembers_comes_back_as_it_was_wherever_it_keeps_it(name, tmp_path):
    (tmp_path / "laws.py").write_text(LAWS)
    sets = [f"controller={{kind: external, python: '{tmp_path}/laws.py:{name}'}}", "duration=0.1"]
    log = run_logged(load_scenario("paper", sets, trust=True), tmp_path / "run.mcap").log
    again = resume(log, 0.03, out=tmp_path / "again.mcap", trust=True).run.log
    assert difference(log, again).equal


@pytest.mark.parametrize("at", [0.001, 0.12])
def test_code_that_remembers_more_than_it_says_is_not_gone_on_with(at, tmp_path):
    (tmp_path / "policies.py").write_text(SOURCE)
    code = f"{tmp_path}/policies.py:Secretive"
    sets = [f"controller={{kind: policy, python: '{code}'}}", "duration=0.2"]
    log = run_logged(load_scenario("paper", sets, trust=True), tmp_path / "run.mcap").log
    out = tmp_path / "again.mcap"
    with pytest.raises(LogError, match=rf"tick {round(at / 1e-3)} .*remembers more than its state"):
        resume(log, at, out=out, trust=True)
    assert not out.exists()


def test_a_policy_goes_on_from_what_it_remembers(tmp_path):
    (tmp_path / "policies.py").write_text(SOURCE)
    sets = [
        f"controller={{kind: policy, python: '{tmp_path}/policies.py:Counter'}}",
        "duration=0.2",
    ]
    log = run_logged(load_scenario("paper", sets, trust=True), tmp_path / "run.mcap").log
    again = resume(log, 0.12, out=tmp_path / "again.mcap", trust=True).run.log
    assert difference(log, again).equal
    faster = resume(log, 0.12, ["controller.torque_scale=9"], trust=True)
    assert faster.told.endswith("the controller goes on as it is")


def test_a_torn_log_is_run_to_its_end(pd):
    torn = pd.with_name("torn.mcap")
    torn.write_bytes(pd.read_bytes()[: pd.stat().st_size * 2 // 3])
    info = log_info(torn)
    assert not info.complete
    for at in (0.2, info.duration):
        assert difference(pd, on(torn, at).run.log).equal
    with pytest.raises(LogError, match=r"--at 1\.3: allowed: 0 to 0\.\d+ s, its end"):
        on(torn, 1.3)


def test_events_that_a_torn_log_has_lost_are_there_again(tmp_path):
    """They are written after the ticks that they are of."""
    limit = "imperfections.torque_limit=56"
    log = log_of(tmp_path, [*PD, limit, "imperfections.velocity_noise=0.1"])
    torn, lost = log.with_name("torn.mcap"), 0
    for size in range(log.stat().st_size // 2, log.stat().st_size, 20_000):
        torn.write_bytes(log.read_bytes()[:size])
        info = log_info(torn)
        lost += sum(e.t < info.duration for e in log_info(log).events) - len(info.events)
        assert difference(log, on(torn, info.duration).run.log).equal
    assert lost > 0


def test_an_interrupted_run_is_finished(pd, tmp_path):
    def stop(_ticks: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(RunInterrupted) as stopped:
        run_logged(load_scenario("paper", PD), tmp_path / "cut.mcap", progress=stop)
    log = stopped.value.log
    assert difference(pd, on(log, log_info(log).duration).run.log).equal


def test_a_run_that_diverged_does_so_again_unless_something_changes(tmp_path):
    sets = ["controller={kind: no_network, observer: {feedback: as_printed}}", "duration=2"]
    log = log_of(tmp_path, sets)
    info = log_info(log)
    assert info.status == "diverged"
    assert difference(log, on(log, info.duration / 2).run.log).equal
    with pytest.raises(LogError, match=r"above 1000 at t = .*; allowed: --at 0\.\d+ or before"):
        on(log, info.duration)
    mended = on(log, info.duration / 2, "controller.observer.feedback=stable")
    assert mended.run.trace.info.status == "ok"


def changed_log(log: Path, **parts: object) -> Path:
    """The same log with another scenario in it: what another machine would have computed."""
    out = log.with_name("changed.mcap")
    scenario = read_trace(log).scenario
    plant = scenario.plant.model_copy(update=parts)
    with out.open("wb") as file:
        writer = LogWriter(file)
        record = scenario_record(scenario.model_copy(update={"plant": plant}))
        writer.add_metadata("scenario", record)
        copy(Prefix(log), writer, leave_out="scenario")
        writer.finish()
    return out


def test_a_log_that_is_not_computed_again_as_it_was_is_refused(pd):
    other = changed_log(pd, gravity=9.82)
    with pytest.raises(LogError, match=r"tick 0 .* not computed again as it was: f_true = \["):
        on(other, 0.3)
    with pytest.raises(LogError, match=r"tick 1000 .*the same versions, so on another kind"):
        on(other, 1.1)


def test_versions_that_differ_are_named(pd, monkeypatch):
    newer = {"mujoco": "99.1.0"}
    monkeypatch.setattr("dnnmso_mj.recomputing.software_versions", lambda: newer)
    with pytest.raises(LogError, match=r"made with mujoco \S+ \(here 99\.1\.0\)"):
        on(changed_log(pd, gravity=9.82), 0.3)


def test_a_missed_deadline_cannot_be_computed_again(tmp_path):
    stall = "real_time.stalls=[{at: 0.1, duration: 0.01}]"
    scenario = load_scenario("paper", [PD[0], "duration=0.2", stall])
    log = run_logged(scenario, tmp_path / "paced.mcap", real_time=True).log
    with pytest.raises(LogError, match=r"a deadline was missed at [\d.]+ s.*allowed: --at from 0"):
        on(log, 0.15)


@pytest.mark.parametrize(
    ("sets", "message"),
    [
        (["dt=0.002"], "--set dt=0.002: dt = 0.002: the ticks before have another"),
        (["initial.q=[1, 2, 3]"], "the run has begun; allowed: what acts from now on"),
        (["controller.kq=3"], "--set controller.kq=3: controller.kq = 3: unknown key; allowed: "),
        (["controller={from: nobody}"], "--set controller={from: nobody}: controller.from"),
        (["plant.gravity"], "--set plant.gravity: no '='"),
        (["duration=0.1"], "duration = 0.1: ends before --at 0.3; allowed: 0.3 or more"),
        (["plant.model=no.xml"], "--set plant.model=no.xml: plant.model = "),
        (["controller={kind: dnn_mso}", "controller.observer.K2=1e9"], "unstable; allowed: K2 < "),
    ],
)
def test_a_change_that_cannot_be_is_refused_and_leaves_nothing(pd, sets, message):
    out = pd.with_name("refused.mcap")
    with pytest.raises(DnnmsoError) as refused:
        resume(pd, 0.3, sets, out)
    assert message in str(refused.value)
    assert not out.exists()


def test_a_log_is_not_replaced_by_what_goes_on_from_it(pd):
    with pytest.raises(LogError, match="is the log itself; allowed: another name"):
        resume(pd, 0.3, out=pd, force=True)
    on(pd, 0.3, name="there")
    with pytest.raises(LogError, match="exists already"):
        resume(pd, 0.3, out=pd.with_name("there.mcap"))


@pytest.mark.parametrize("at", [-0.1, 1.41, 1e308, float("nan"), float("inf")])
def test_a_time_that_the_log_has_not_is_refused(pd, at):
    with pytest.raises(LogError, match=r"--at .*: allowed: 0 to 1\.4 s, its end"):
        on(pd, at)


def test_the_command_says_where_it_went_on_and_what_it_left(pd):
    command = [sys.executable, "-m", "dnnmso_mj", "resume", pd.name, "--at", "1.217", "--json"]
    command += ["--no-plot", "--set", "controller.kp=80"]
    done = subprocess.run(command, cwd=pd.parent, capture_output=True, text=True, check=True)
    said = json.loads(done.stdout)
    assert (said["at"], said["checked_ticks"]) == (1.217, 217)
    assert said["log"] == "run-from-1.217.mcap"
    info = log_info(pd.parent / said["log"])
    assert said["metrics"] == dict(info.metrics)
    assert info.ticks == 1400
