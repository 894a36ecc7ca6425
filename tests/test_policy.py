"""`controller: {kind: policy}`: files and classes do what they say, and are refused by name."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from policy_samples import SCALE, weights, write_onnx, write_python, write_torchscript

from dnnmso_mj.comparison.plan import plan_comparison
from dnnmso_mj.controllers import Inputs, build_controller
from dnnmso_mj.environments.episode import Episode
from dnnmso_mj.environments.start import Start, episode_scenario
from dnnmso_mj.errors import DnnmsoError, MissingExtraError, ScenarioError
from dnnmso_mj.loading import controller_kinds, load_scenario
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.observation import torque_scale
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.reading import read_trace
from dnnmso_mj.run import run_logged
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.simulation import Simulation, simulate
from dnnmso_mj.sweep.local import LocalEngine
from dnnmso_mj.sweep.run import run_sweep

IMPERFECT = "imperfections={position_noise: 1e-4, velocity_noise: 1e-3, actuator_delay: 0.0023}"
SETS = ["duration=1", "seed=5", IMPERFECT]
FORMS = ["law.pt", "law.onnx", "flat.onnx", "laws.py:PdLaw"]


@pytest.fixture(scope="module")
def laws(tmp_path_factory) -> Path:
    """A folder with the same law in every form."""
    folder = tmp_path_factory.mktemp("policies")
    write_python(folder)
    write_torchscript(folder / "law.pt", weights())
    write_onnx(folder / "law.onnx", weights())
    write_onnx(folder / "flat.onnx", weights(), (12,))
    write_onnx(folder / "single.onnx", weights().astype(np.float32), (1, 12))
    write_onnx(folder / "short.onnx", weights()[:, :8], (1, 8))
    write_torchscript(folder / "short.pt", weights()[:, :8])
    write_torchscript(folder / "long.pt", np.zeros((3, 12)))
    (folder / "junk.pt").write_text("junk")
    (folder / "junk.onnx").write_text("junk")
    return folder


@pytest.fixture(scope="module")
def pd():
    return simulate(load_scenario("paper", SETS, controller="pd"))


def named(folder: Path, name: str, *sets: str, scale: float = SCALE) -> Scenario:
    key = "python" if ".py:" in name else "file"
    chosen = f"controller={{kind: policy, {key}: '{folder / name}', torque_scale: {scale}}}"
    return load_scenario("paper", [*SETS, chosen, *sets], trust=True)


# What it does


@pytest.mark.parametrize("form", FORMS)
def test_a_pd_law_in_any_form_runs_as_kind_pd_does(laws, pd, form):
    trace = simulate(named(laws, form))
    for name in ("q", "qd", "q_meas", "qd_meas"):
        assert np.abs(trace[name] - pd[name]).max() < 1e-9, name
    assert np.abs(trace["tau"] - pd["tau"]).max() < 1e-9 * SCALE
    for name in ("q_ref", "f_true", "x_hat", "f_hat"):
        assert np.allclose(trace[name], pd[name], atol=1e-7), name


def test_a_policy_in_single_precision_is_given_single_precision(laws, pd):
    trace = simulate(named(laws, "single.onnx"))
    assert 0 < np.abs(trace["q"] - pd["q"]).max() < 1e-5


@pytest.mark.parametrize("every", [1, 8])
def test_it_sees_and_does_what_it_sees_and_does_in_an_environment(laws, every):
    from dnnmso_mj.importing import import_named

    law = import_named(f"{laws / 'laws.py'}:PdLaw", "x", "x")()
    held = f"controller.control_timestep={every * 0.001}"
    scenario = named(laws, "laws.py:PdLaw", held, scale=700.1)
    episode = Episode(scenario, scale=700.1)
    episode.restart(episode_scenario(episode.scenario, scenario.seed, Start()))
    while not episode.over:
        episode.hold(episode.torque(law(episode.observation())), every)
    alone, driven = simulate(scenario), episode.trace()
    for name in set(alone) - {"compute_us"}:
        assert np.array_equal(alone[name], driven[name]), name


def test_an_action_beyond_one_is_cut_to_the_scale(laws):
    short = "controller.settings={scale: 100.0}"
    trace = simulate(named(laws, "laws.py:PdLaw", short, scale=100.0))
    assert trace["tau_cmd"].max() == 100.0  # of 287 that the law would have
    assert trace["tau_cmd"].min() == -100.0


def test_the_scale_is_the_torque_limit_or_what_the_documentation_says(make_scenario):
    assert torque_scale(make_scenario()).tolist() == [128.0, 128.0]
    limited = make_scenario(imperfections={"torque_limit": [60.0, 40.0]})
    assert torque_scale(limited).tolist() == [60.0, 40.0]
    assert torque_scale(limited, (7.0,)).tolist() == [7.0, 7.0]


def test_settings_are_its_arguments(laws, pd):
    soft = simulate(named(laws, "laws.py:PdLaw", "controller.settings={kp: 100.0}"))
    assert np.abs(soft["tau"]).max() < 0.5 * np.abs(pd["tau"]).max()


def test_what_a_policy_remembers_begins_anew_and_is_its_state(laws):
    scenario = named(laws, "laws.py:Counter", scale=1000.0)
    arm = Mjcf.read(find_model("two_link"))
    one, two = build_controller(scenario, arm), build_controller(scenario, arm)
    one.reset(np.zeros(4))
    trace = simulate(scenario)
    assert np.allclose(trace["tau_cmd"][:3, 0], [1.0, 2.0, 3.0])
    assert one.state()["ticks"].tolist() == [0]
    state = {"held": np.array([0]), "tau": np.zeros(2), "ticks": np.array([41])}
    two.restore(state)
    assert {name: value.tolist() for name, value in two.state().items()} == {
        name: value.tolist() for name, value in state.items()
    }


def test_an_entry_point_names_a_policy_too(laws, tmp_path, monkeypatch, pd):
    info = tmp_path / "other-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[dnnmso_mj.policies]\npd_law = laws:PdLaw\n")
    monkeypatch.syspath_prepend(str(laws))
    monkeypatch.syspath_prepend(str(tmp_path))
    sets = [f"controller={{kind: policy, python: pd_law, torque_scale: {SCALE}}}"]
    trace = simulate(load_scenario("paper", [*SETS, *sets]))
    assert np.abs(trace["q"] - pd["q"]).max() < 1e-9


def test_a_log_says_which_policy_it_was(laws, tmp_path):
    scenario = named(laws, "law.onnx", "duration=0.05")
    trace = read_trace(run_logged(scenario, tmp_path / "run.mcap").log)
    assert trace.scenario == scenario
    assert len(trace.scenario.controller.sha256) == 64


def test_a_file_of_its_own_is_compared_with_kinds_from_any_folder(laws, tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    write_onnx(folder / "law.onnx", weights())
    text = f"controller: {{kind: policy, file: law.onnx, torque_scale: {SCALE}}}\n"
    (folder / "my_policy.yaml").write_text(text)
    name = str(folder / "my_policy.yaml")
    plan = plan_comparison("paper", ["pd", name], range(2), ["duration=0.2", IMPERFECT])
    table = run_sweep(plan, tmp_path / "x.parquet", LocalEngine(1)).table.to_pylist()
    errors = {(row["controller"], row["seed"]): row["rmse"] for row in table}
    assert len(errors) == 4
    for seed in range(2):
        assert errors[name, seed] == pytest.approx(errors["pd", seed], rel=1e-9)
    assert errors["pd", 0] != errors["pd", 1]


def test_paths_are_from_the_file_that_names_them(laws, tmp_path, monkeypatch):
    scenario = tmp_path / "s.yaml"
    scenario.write_text(
        "name: s\nreference: {kind: sinusoid}\n"
        "controller: {kind: policy, python: 'laws.py:PdLaw'}\n"
    )
    spec = load_scenario(scenario, trust=True).controller
    assert spec.python == f"{tmp_path / 'laws.py'}:PdLaw"
    beside = f"controller={{from: '{laws / 'p.yaml'}', torque_scale: 9}}"
    (laws / "p.yaml").write_text("controller: {kind: policy, file: law.pt}\n")
    assert load_scenario("paper", [beside], trust=True).controller.file == str(laws / "law.pt")
    monkeypatch.chdir(laws)
    named = ["controller={kind: policy, file: law.pt}"]
    assert load_scenario(scenario, named, trust=True).controller.file == (str(laws / "law.pt"))
    changed = load_scenario(scenario, ["controller.python=other.py:X"], trust=True).controller
    assert changed.python == f"{laws / 'other.py'}:X"


def test_it_is_no_kind_that_its_defaults_make_whole():
    assert "policy" not in controller_kinds()
    assert "pd" in controller_kinds()


def test_a_restored_controller_holds_on_to_its_action(laws):
    scenario = named(laws, "laws.py:Counter", "controller.control_timestep=0.003", scale=1000.0)
    arm, inputs = Mjcf.read(find_model("two_link")), Inputs.zeros(2)
    one, two = build_controller(scenario, arm), build_controller(scenario, arm)
    one.reset(np.zeros(4))
    told = [one.update(inputs).tau[0] for _ in range(4)]
    assert np.allclose(told, [1.0, 1.0, 1.0, 2.0])
    two.restore(one.state())
    assert np.allclose([two.update(inputs).tau[0] for _ in range(4)], [2.0, 2.0, 3.0, 3.0])


def test_a_run_goes_on_from_the_middle_as_it_was(laws):
    scenario = named(laws, "laws.py:Counter", "controller.control_timestep=0.003", scale=90.0)
    arm, whole = Mjcf.read(find_model("two_link")), simulate(scenario)
    first = Simulation(scenario, arm)
    first.run(MemoryRecorder(first.layout, scenario.n_ticks), until=401)
    second = Simulation(scenario, arm)
    recorder = MemoryRecorder(second.layout, scenario.n_ticks)
    rest = recorder.trace(scenario, second.run(recorder, start=first.state()))
    for name in ("q", "qd_meas", "tau_cmd", "tau"):
        assert np.array_equal(rest[name], whole[name][401:]), name


# What is refused


@pytest.mark.parametrize(
    ("controller", "problem"),
    [
        (
            "{}",
            "controller.file = null (the default): is missing, and python too; allowed: exactly",
        ),
        ("{file: law.pt, python: 'laws.py:PdLaw'}", "stands beside file; allowed: exactly one"),
        (
            "{file: law.zip}",
            "is no known kind of file; allowed: a name that ends in .pt, .ts, .onnx",
        ),
        ("{file: law.pt, settings: {a: 1}}", "are for python; allowed: none beside file"),
        ("{file: none.pt}", "No such file or directory; allowed: a file of TorchScript (.pt, .ts)"),
        ("{file: junk.pt}", "torch cannot read it:"),
        ("{file: junk.onnx}", "onnxruntime cannot read it: InvalidProtobuf"),
        ("{file: short.pt}", "an observation of shape (12,) fails: RuntimeError:"),
        ("{file: short.onnx}", "an observation of shape (12,) fails: InvalidArgument"),
        ("{file: long.pt}", "gives an action of shape (3,); allowed: (2,), one for each joint"),
        ("{python: 'laws.py:Nobody'}", 'no name "Nobody" there; it has Counter, Forgets, PdLaw'),
        ("{python: 'laws.py:make_long'}", "gives an action of shape (3,); allowed: (2,)"),
        ("{python: 'laws.py:make_sour'}", "RuntimeError: a policy of no use"),
        ("{python: 'laws.py:nothing'}", "called without settings it gives a NoneType; allowed"),
        ("{python: 'laws.py:not_callable'}", "is of int; allowed: a class or function"),
        ("{python: 'laws.py:Forgets'}", "has state or restore alone; allowed: both, or none"),
        ("{python: 'laws.py:PdLaw', settings: {ki: 1}}", "cannot be called with settings {ki: 1}"),
        ("{python: nobody}", "no entry point of the group dnnmso_mj.policies"),
        ("{file: law.pt, control_timestep: 0.0015}", "is no multiple of dt = 0.001 within"),
        ("{file: law.pt, torque_scale: [1, 2, 3]}", "torque_scale = [1, 2, 3]: has 3 entries"),
    ],
)
def test_what_is_no_policy_is_refused_with_its_name(laws, monkeypatch, controller, problem):
    monkeypatch.chdir(laws)
    chosen = "controller={kind: policy, " + controller[1:]
    with pytest.raises(DnnmsoError, match="controller") as refused:
        simulate(load_scenario("paper", ["duration=0.01", chosen], trust=True))
    assert problem in str(refused.value)
    assert "\n" not in str(refused.value)


def test_another_file_than_the_one_that_was_loaded_is_refused(laws, tmp_path):
    write_onnx(tmp_path / "law.onnx", weights())
    scenario = named(tmp_path, "law.onnx")
    write_onnx(tmp_path / "law.onnx", 2 * weights())
    with pytest.raises(ScenarioError, match=r"controller\.sha256 = .*; allowed: the file"):
        simulate(scenario)


@pytest.mark.parametrize(("form", "package"), [("law.pt", "torch"), ("law.onnx", "onnxruntime")])
def test_what_runs_a_file_is_named_where_it_is_not_installed(laws, monkeypatch, form, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match=rf"needs {package}.*pip install"):
        simulate(named(laws, form))


def test_an_action_that_is_not_finite_ends_the_run_with_its_time(laws):
    trace = simulate(named(laws, "laws.py:make_late"))
    assert trace.info.status == "diverged"
    assert trace.info.reason == "the policy's action = [nan, nan] at t = 0.001 s"
    assert len(trace) == 1


def test_the_torques_of_an_episode_are_not_in_its_scenario(make_scenario):
    episode = Episode(make_scenario(duration=0.1))
    with pytest.raises(DnnmsoError, match="came from outside"):
        simulate(episode.scenario)
