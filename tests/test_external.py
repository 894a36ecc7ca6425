"""Controllers, references, imperfections and robots from outside the package."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from outside_samples import CANARY, LAWS, write_package
from typer.main import get_command

from dnnmso_mj.cli import app
from dnnmso_mj.cli.audit import audit
from dnnmso_mj.cli.compare import compare
from dnnmso_mj.cli.margins import margins
from dnnmso_mj.cli.sweep import sweep
from dnnmso_mj.comparison.plan import plan_comparison
from dnnmso_mj.controllers import Inputs, build_controller
from dnnmso_mj.dynamics import TwoLink
from dnnmso_mj.errors import ExternalError, ScenarioError
from dnnmso_mj.external.reference import CHECKED, STEP
from dnnmso_mj.loading import controller_kinds, load_scenario, require_trust, scenario_schema
from dnnmso_mj.log.format import snapshot_data
from dnnmso_mj.log.npz import read_npz
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.paths import find_model, models_dir
from dnnmso_mj.reading import read_trace
from dnnmso_mj.run import run_logged
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.simulation import Simulation, simulate
from dnnmso_mj.sweep.local import LocalEngine
from dnnmso_mj.sweep.plan import plan_sweep
from dnnmso_mj.sweep.run import run_sweep
from dnnmso_mj.trace import Trace
from dnnmso_mj.tuning import TuneError
from dnnmso_mj.tuning.search import Request, Search

CLOCKED = {"compute_us"}
SHORT = "duration=0.3"


@pytest.fixture
def laws(tmp_path, monkeypatch) -> Path:
    """The current folder, with laws.py in it."""
    (tmp_path / "laws.py").write_text(LAWS)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def package(tmp_path, monkeypatch) -> Path:
    """An installed package; a folder that Python finds it in."""
    site = tmp_path / "site"
    write_package(site, (models_dir() / "two_link.xml").read_text())
    monkeypatch.syspath_prepend(site)
    yield site
    for name in [name for name in sys.modules if name.partition(".")[0] == "outside_package"]:
        del sys.modules[name]


def outside(python: str, *sets: str, **settings) -> Scenario:
    """The paper's scenario with a controller from outside."""
    spec = json.dumps({"kind": "external", "python": python, "settings": settings})
    return load_scenario("paper", [SHORT, f"controller={spec}", *sets], trust=True)


def run_pd(*sets: str) -> Trace:
    return simulate(
        load_scenario("paper", [SHORT, "controller={kind: pd, kp: 512, kd: 128}", *sets])
    )


def run(simulation: Simulation) -> Trace:
    recorder = MemoryRecorder(simulation.layout, simulation.scenario.n_ticks)
    return recorder.trace(simulation.scenario, simulation.run(recorder))


def check_same(one: Trace, other: Trace) -> None:
    assert len(one) == len(other)
    for name in set(one) - CLOCKED:
        assert np.array_equal(one[name], other[name], equal_nan=True), name


# Gains that are powers of two: compiled code may join a product to a sum and round it once.
@pytest.mark.parametrize(
    "python", ["laws.py:Pd", "laws.py:Same", "outside_package.laws:Pd", "outside_pd"]
)
def test_the_same_law_from_outside_gives_the_same_run(python, laws, package):
    scenario = outside(python, kp=512.0, kd=128.0)
    check_same(simulate(scenario), run_pd())


def test_a_run_again_and_a_restored_controller_go_on_alike(laws, two_link):
    scenario = outside("laws.py:Remembers")
    simulation = Simulation(scenario, two_link)
    check_same(run(simulation), run(simulation))

    one, other = (build_controller(scenario, two_link) for _ in range(2))
    inputs = Inputs.zeros(2)
    inputs.x[:] = 0.3
    one.reset(inputs.x)
    for _ in range(5):
        one.update(inputs)
    state = read_npz(snapshot_data(one.state()))  # through a log
    other.restore(state)
    for _ in range(5):
        assert np.array_equal(one.update(inputs).tau, other.update(inputs).tau)
    before = build_controller(scenario, two_link)
    before.reset(inputs.x)
    assert not np.array_equal(before.update(inputs).tau, one.update(inputs).tau)


def test_its_state_is_in_the_log_and_reading_that_imports_nothing(laws):
    logged = run_logged(outside("laws.py:Remembers"), laws / "run.mcap")
    (laws / "laws.py").write_text("raise SystemExit('imported')")
    code = f"from dnnmso_mj import read_trace; print(read_trace({str(logged.log)!r}).scenario.name)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout == "paper\n"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Gone", 'no name "Gone" there; it has'),
        ("NUMBER", "is of int; allowed: a class or function"),
        ("Silent", "Silent has no update; allowed: update(inputs), which gives the torque"),
        ("Half", "Half has no reset, no dynamics, no state, no restore; allowed: a whole"),
        ("Wide", "Wide.update gives an array (3,); allowed: a torque (N·m) (2,)"),
        ("Breaks", "Breaks.update fails: ZeroDivisionError: division by zero"),
        ("Queues", "Queues has an attribute past of deque, which no log can hold; allowed:"),
        ("Named", "Named has an attribute gains of Gains, which no log can hold; allowed:"),
        ("Forgets", "Forgets has state alone; allowed: state and restore, or neither"),
        ("Untold", "Untold.update gives ndarray; allowed: a Command"),
    ],
)
def test_what_is_no_controller_is_refused(name, words, laws):
    with pytest.raises((ScenarioError, ExternalError)) as caught:
        simulate(outside(f"laws.py:{name}"))
    assert words in str(caught.value)


def test_settings_that_it_does_not_take_are_refused_with_what_it_was_called_with(laws):
    with pytest.raises(ScenarioError, match=r"called with \(setup, kp, ki\) it fails.*'ki'"):
        simulate(outside("laws.py:Pd", kp=3.0, ki=1.0))
    for wrong in ("3", "{a: .nan}", "{a: [1, .inf]}"):
        with pytest.raises(ScenarioError, match=r"controller\.settings.*; allowed: "):
            outside("laws.py:Pd", f"controller.settings={wrong}")


def test_a_torque_that_is_not_finite_ends_the_run(laws):
    trace = simulate(outside("laws.py:Blind"))
    assert (trace.info.status, len(trace)) == ("diverged", 0)


def test_a_kind_that_needs_code_is_not_among_those_that_stand_alone():
    assert "external" not in controller_kinds()
    assert {"pd", "dnn_mso"} <= set(controller_kinds())


def test_tuning_one_is_refused_with_what_can_be_tuned(laws):
    Path("mine.yaml").write_text("controller: {kind: external, python: 'laws.py:Pd'}\n")
    request = Request("paper", "mine.yaml", seeds=[0], trials=2, trust=True)
    with pytest.raises(TuneError, match=r"kind = external: nothing of it is tuned; allowed: dnn"):
        Search(request)


# --- trust ------------------------------------------------------------------------------------

PATHS = {
    "controller.python": "controller={kind: external, python: 'canary.py:Name'}",
    "reference.python": "reference={kind: external, python: 'canary.py:Name'}",
    "imperfections.external.0.python": "imperfections.external=[{python: 'canary.py:Name'}]",
    "controller.settings.deep.0.python": (
        "controller={kind: external, python: x, settings: {deep: [{python: 'canary.py:Name'}]}}"
    ),
}


@pytest.fixture
def canary(tmp_path, monkeypatch) -> Path:
    """A file that leaves another one behind when it is run."""
    (tmp_path / "canary.py").write_text(CANARY)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "it_ran"


@pytest.mark.parametrize("key", PATHS)
def test_code_that_is_named_by_its_place_is_refused_and_not_run(key, canary):
    with pytest.raises(ScenarioError) as caught:
        load_scenario("paper", [PATHS[key]])
    place, rest = str(caught.value).split(f" {key} = ")
    assert place == f"--set {PATHS[key]}:"
    assert rest.endswith(
        "runs code of its own; allowed: --trust (trust=True), if you know the scenario and that "
        "code"
    )
    scenario = load_scenario("paper", [PATHS[key]], trust=True)
    with pytest.raises(ScenarioError, match=rf"run\.mcap: {key}"):
        require_trust(scenario, "run.mcap")
    scenario_schema()
    assert not canary.exists()
    if key != "controller.settings.deep.0.python":  # the canary itself: it does see imports
        with pytest.raises((ScenarioError, ExternalError)):
            simulate(scenario)
        assert canary.exists()


def test_a_controller_of_another_file_is_refused_too_with_its_line(canary, tmp_path):
    (tmp_path / "folder").mkdir()
    tuned = tmp_path / "folder" / "mine.yaml"
    tuned.write_text("controller:\n  kind: external\n  python: canary.py:Name\n")
    own = tmp_path / "own.yaml"
    own.write_text("name: own\nreference: {kind: sinusoid}\ncontroller: {from: folder/mine.yaml}\n")
    for refused in (
        lambda: load_scenario(own),
        lambda: load_scenario("paper", [f"controller.from={tuned}"]),
        lambda: load_scenario("paper", controller=str(tuned)),
    ):
        with pytest.raises(ScenarioError, match=r"mine\.yaml:3: controller\.python"):
            refused()
    for refused in (
        lambda: plan_comparison("paper", ["pd", str(tuned)], [0]),
        lambda: plan_sweep("paper", [0], grid=["reference.python=canary.py:Name,canary.py:Other"]),
    ):
        with pytest.raises(ScenarioError, match="runs code of its own"):
            refused()
    assert not canary.exists()


def test_every_command_that_changes_a_scenario_can_be_told_to_trust_it():
    commands = get_command(app).commands
    for name, command in commands.items():
        options = {option for parameter in command.params for option in parameter.opts}
        assert ("--trust" in options) == ("--set" in options), name
    assert {"run", "sweep", "compare", "margins", "tune", "audit"} <= set(commands)


COMMANDS = {
    "sweep": lambda **how: sweep("own.yaml", "0", **how),
    "compare": lambda **how: compare("paper", "mine.yaml,pd", "0", **how),
    "margins": lambda **how: margins("paper", "mine.yaml", "0", **how),
    "audit": lambda **how: audit("own.yaml", **how),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_hands_its_trust_on(name, canary):
    controller = "controller: {kind: external, python: 'canary.py:Name'}\n"
    Path("mine.yaml").write_text(controller)
    Path("own.yaml").write_text("name: own\nreference: {kind: sinusoid}\n" + controller)
    with pytest.raises(ScenarioError, match="runs code of its own"):
        COMMANDS[name]()
    assert not canary.exists()
    with pytest.raises(ScenarioError, match="is of NoneType; allowed: a class"):
        COMMANDS[name](trust=True)
    assert canary.exists()


def test_the_command_line_refuses_in_one_line_and_runs_what_it_is_told_to_trust(canary):
    Path("own.yaml").write_text(
        "name: own\nreference: {kind: sinusoid}\n"
        "controller: {kind: external, python: 'canary.py:Name'}\n"
    )
    for flags, ran in (([], False), (["--trust"], True)):
        command = [sys.executable, "-m", "dnnmso_mj", "run", "own.yaml", *flags]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        said = "is of NoneType; allowed: a class" if ran else "own.yaml:3: controller.python"
        assert (done.returncode, said in done.stderr) == (2, True), done.stderr
        assert canary.exists() == ran
        assert "Traceback" not in done.stderr


def test_an_entry_point_needs_no_trust(package):
    sets = [SHORT, "controller={kind: external, python: outside_pd}"]
    scenario = load_scenario("paper", sets)
    require_trust(scenario, "run.mcap")
    check_same(simulate(scenario), run_pd())


def test_an_entry_point_that_is_not_there_is_refused_with_those_that_are(package):
    for name, words in {
        "outside_pid": r"installed: broken, outside_pd\).*did you mean 'outside_pd'",
        "broken": "its entry point outside_package.laws:Gone cannot be imported",
    }.items():
        with pytest.raises(ScenarioError, match=words):
            simulate(load_scenario("paper", [f"controller={{kind: external, python: {name}}}"]))


def test_a_file_is_looked_for_from_the_file_that_names_it(laws, monkeypatch):
    folder = laws / "folder"
    folder.mkdir()
    (folder / "laws.py").write_text(LAWS.replace("512.0", "64.0"))
    (folder / "own.yaml").write_text(
        "name: own\nreference: {kind: sinusoid}\n"
        "controller: {kind: external, python: 'laws.py:Pd'}\n"
    )
    (folder / "mine.yaml").write_text("controller: {kind: external, python: 'laws.py:Pd'}\n")

    def where(*sets: str) -> str:
        return load_scenario("folder/own.yaml", sets, trust=True).controller.python

    assert where() == f"{folder}/laws.py:Pd"
    assert where("controller.from=folder/mine.yaml") == f"{folder}/laws.py:Pd"
    assert where("controller.python=laws.py:Pd") == f"{laws}/laws.py:Pd"
    assert where("controller={kind: external, python: 'laws.py:Pd'}") == f"{laws}/laws.py:Pd"
    assert where("controller.python=outside_package.laws:Pd") == "outside_package.laws:Pd"


# --- references -------------------------------------------------------------------------------


def follow(name: str, **settings) -> Scenario:
    spec = json.dumps({"kind": "external", "python": name, "settings": settings})
    return load_scenario("paper", [SHORT, f"reference={spec}"], controller="pd", trust=True)


def test_a_reference_from_outside_is_followed(laws, package):
    built_in = load_scenario("paper", [SHORT], controller="pd")
    for name in ("laws.py:swing", "outside_swing"):
        trace = simulate(follow(name))
        assert np.allclose(trace["q_ref"], simulate(built_in)["q_ref"], atol=1e-15)
    assert not np.allclose(simulate(follow("laws.py:swing", size=0.5))["q_ref"], trace["q_ref"])


@pytest.mark.parametrize(
    ("name", "settings", "words"),
    [
        ("swing", {"slip": 0.01}, "qd is not the derivative of q: at t = "),
        ("swing", {"sise": 1.0}, "unexpected keyword argument 'sise'"),
        ("two", {}, "gives tuple; allowed: q, qd, qdd"),
        ("flat", {}, "gives q of shape (400,) at 400 times; allowed: (400, 2)"),
        ("ends", {}, "at t = 0.4"),
        ("NUMBER", {}, "is of int; allowed: a class or function"),
    ],
)
def test_what_is_no_reference_is_refused(name, settings, words, laws):
    with pytest.raises((ScenarioError, ExternalError)) as caught, np.errstate(all="ignore"):
        simulate(follow(f"laws.py:{name}", **settings).model_copy(update={"duration": 0.5}))
    assert str(caught.value).startswith("reference.python = ")
    assert words in str(caught.value)


def test_a_corner_is_no_wrong_derivative(laws):
    looked_at = 0.3 * 100.618 / CHECKED
    for beside in (-0.5 * STEP, 0.5 * STEP):
        assert simulate(follow("laws.py:ramp", at=looked_at + beside)).info.status == "ok"


# --- imperfections ----------------------------------------------------------------------------


def spoil(*names: str, sets: tuple[str, ...] = (), **settings) -> Scenario:
    """PD with imperfections from outside."""
    specs = [{"python": f"laws.py:{name}", "settings": settings} for name in names]
    sets = (SHORT, f"imperfections.external={json.dumps(specs)}", *sets)
    return load_scenario("paper", sets, controller="pd", trust=True)


def test_readings_and_torques_are_changed_where_the_page_says(laws):
    limits = ("imperfections.torque_limit=60", "imperfections.position_bias=0.02")
    trace = simulate(spoil("Off", "Off", sets=limits))
    assert np.allclose(trace["q_meas"] - trace["q"], 0.02 + 2 * 0.01)
    assert np.allclose(trace["qd_meas"] - trace["qd"], 2 * 0.01)
    assert np.abs(trace["tau_cmd"]).max() > 240
    assert np.array_equal(trace["tau"], np.clip(0.25 * trace["tau_cmd"], -60, 60))
    # What the network should learn is that of the arm, whatever its motors made of the command.
    free = TwoLink((1.0, 2.3), (1.0, 1.0)).acceleration(
        trace["q"], trace["qd"], np.zeros_like(trace["q"])
    )
    assert np.allclose(trace["f_true"][:, 2:], free, atol=1e-9)


def test_one_that_changes_nothing_changes_no_run_though_it_is_interpreted(laws):
    check_same(simulate(spoil("Off", offset=0.0, gain=1.0)), simulate(spoil()))


def test_its_random_numbers_are_those_of_the_seed_and_its_place(laws, two_link):
    one, same, other = (simulate(spoil("Noisy", sets=(f"seed={s}",)))["q_meas"] for s in (1, 1, 2))
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)
    simulation = Simulation(spoil("Noisy", "Noisy"), two_link)
    twice = [run(simulation) for _ in range(2)]
    check_same(*twice)
    noise = twice[0]["q_meas"] - twice[0]["q"]
    alone = simulate(spoil("Noisy"))
    assert not np.allclose(noise, 2 * (alone["q_meas"] - alone["q"]))


def test_the_controller_begins_with_the_reading_of_the_first_tick(laws, two_link):
    sets = ('imperfections.external=[{python: "laws.py:Noisy"}]',)
    simulation = Simulation(outside("laws.py:Remembers", *sets), two_link)
    trace = run(simulation)
    begun_at = simulation.controller.state()["begun_at"]
    assert np.array_equal(begun_at, np.concatenate([trace["q_meas"][0], trace["qd_meas"][0]]))


def test_one_goes_on_from_its_state(laws, two_link):
    one, other = (Simulation(spoil("Noisy"), two_link).stage.hooks for _ in range(2))
    x = np.zeros(4)
    for _ in range(3):
        one.sense(0.0, x)
    other.restore(read_npz(snapshot_data(one.state())))
    ours, theirs = np.zeros((2, 4))
    one.sense(0.0, ours)
    other.sense(0.0, theirs)
    assert np.array_equal(ours, theirs)
    assert ours.any()


@pytest.mark.parametrize(
    ("name", "who"),
    [("BadSensor", "BadSensor.sense"), ("BadDrive", "BadDrive.actuate")],
)
def test_what_is_not_finite_ends_the_run_and_is_named(name, who, laws):
    with np.errstate(all="ignore"):
        trace = simulate(spoil(name, at=0.1))
    assert (trace.info.status, len(trace)) == ("diverged", 100)
    assert trace.info.reason.startswith(f"imperfections.external.0: {who} = [")
    assert trace.info.reason.endswith("at t = 0.1 s")


def test_what_does_nothing_is_refused(laws):
    with pytest.raises(ScenarioError, match="Silent has neither sense nor actuate; allowed: "):
        simulate(spoil("Silent"))


# --- robots -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["outside_package.arms:arm.xml", "outside_arm"])
def test_a_robot_of_a_package_is_found_without_importing_it(name, package):
    sets = [SHORT, f"plant.model={name}", "plant.masses=[1.0, 2.3]", "plant.lengths=[1.0, 1.0]"]
    scenario = load_scenario("paper", sets, controller="pd")
    assert scenario.plant.model == name
    assert find_model(name) == package / "outside_package" / "arms" / "arm.xml"
    assert "outside_package" not in sys.modules
    check_same(simulate(scenario), simulate(load_scenario("paper", [SHORT], controller="pd")))


@pytest.mark.parametrize(
    "name", ["outside_package:arm.xml", "no_package:arm.xml", "a b:c", ":x", "made_by_hand:x"]
)
def test_a_robot_that_is_not_there_is_refused_with_what_is(name, package, monkeypatch):
    monkeypatch.setitem(sys.modules, "made_by_hand", ModuleType("made_by_hand"))  # as __main__
    with pytest.raises(ScenarioError, match=r"allowed: an MJCF file, .*two_link, outside_arm; or"):
        load_scenario("paper", [f"plant.model={json.dumps(name)}"])


# --- where runs are made ----------------------------------------------------------------------


def test_workers_of_a_sweep_import_it_too(laws, package):
    (laws / "mine.yaml").write_text(
        "controller: {kind: external, python: 'laws.py:Pd', settings: {kp: 512.0}}\n"
    )
    sets = [
        SHORT,
        'reference={kind: external, python: "outside_package.laws:swing"}',
        "imperfections.external=[{python: outside_off, settings: {offset: 0.0, gain: 1.0}}]",
    ]
    controllers = ["mine.yaml", "pd"]
    plan = plan_comparison("paper", controllers, range(2), sets, trust=True)
    table = run_sweep(plan, laws / "t.parquet", LocalEngine(2)).table.to_pydict()
    assert table["status"] == ["ok"] * 4, table["reason"]
    alone = simulate(plan.points[0].scenario)
    assert table["rmse"][0] == alone.metrics["rmse"]


def test_a_sweep_does_not_go_on_with_other_code(laws, package):
    sets = [SHORT, "controller={kind: external, python: 'laws.py:Pd'}"]
    sets += ["imperfections.external=[{python: outside_off}]"]
    before = plan_sweep("paper", [0], sets, trust=True).definition()
    assert before == plan_sweep("paper", [0], sets, trust=True).definition()
    for file in (laws / "laws.py", package / "outside_package" / "laws.py"):
        file.write_text(LAWS + "\n")
        after = plan_sweep("paper", [0], sets, trust=True).definition()
        assert set(before["outside"]) == set(after["outside"])
        assert before["outside"] != after["outside"]
        before = after


def test_a_run_by_the_command_line_is_the_library_s(laws, package):
    command = [sys.executable, "-m", "dnnmso_mj", "run", "paper", "--trust", "--no-plot"]
    command += ["--out", "run.mcap", "--set", SHORT]
    command += ["--set", "controller={kind: external, python: outside_pd}"]
    environment = os.environ | {"PYTHONPATH": f"{package}:{os.environ.get('PYTHONPATH', '')}"}
    subprocess.run(command, env=environment, check=True, capture_output=True)
    check_same(read_trace("run.mcap"), run_pd())
