"""Tuned controllers in files: taken whole, overridden key by key, refused with their own lines."""

from __future__ import annotations

from pathlib import Path

import pytest
from jsonschema import Draft202012Validator
from sweep_samples import dnnmso

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.loading import controller_kinds, load_scenario, scenario_schema
from dnnmso_mj.paths import shipped_controllers
from dnnmso_mj.scenario import Constant, DnnMso, Inertia, NoNetwork
from dnnmso_mj.sweep.plan import plan_sweep

TUNED = """\
controller:
  kind: no_network
  inversion:
    K: 9.0
    lam: 11.0
    effectiveness:
      kind: inertia
      masses: [1.5, 2.5]
      lengths: [1.0, 1.0]
tuning:
  study: by hand
  budget: 20
  seeds: 1000:1010
  scenario: paper
  objective: rmse_steady
  value: 0.2
  command: dnnmso tune paper
  date: 2026-11-22
  version: 0.1.0
"""
SCENARIO = """\
name: tuned
reference: {kind: sinusoid}
controller:
  from: gains.yaml
"""


@pytest.fixture
def scenario(tmp_path) -> Path:
    """A scenario in a folder of its own, with the controller that it takes beside it."""
    folder = tmp_path / "scenarios"
    folder.mkdir()
    (folder / "gains.yaml").write_text(TUNED)
    file = folder / "tuned.yaml"
    file.write_text(SCENARIO)
    return file


def refusal(*arguments: object, **options: str) -> str:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(*arguments, **options)
    return str(caught.value)


# What is taken


def test_a_scenario_takes_the_controller_from_a_file_beside_it(scenario):
    controller = load_scenario(scenario).controller
    assert isinstance(controller, NoNetwork)
    assert controller.inversion.K == (9.0,)
    assert controller.inversion.effectiveness == Inertia(
        kind="inertia", masses=(1.5, 2.5), lengths=(1.0, 1.0)
    )


def test_keys_beside_from_override_what_it_brings_group_by_group(scenario):
    scenario.write_text(f"{SCENARIO}  kinematics: false\n  inversion: {{lam: 3.0}}\n")
    controller = load_scenario(scenario).controller
    assert controller.kinematics is False
    assert (controller.inversion.K, controller.inversion.lam) == ((9.0,), 3.0)


def test_a_group_whose_kind_is_changed_is_the_scenario_s_alone(scenario):
    more = "  inversion: {effectiveness: {kind: constant, b: 2.0}}\n"
    scenario.write_text(SCENARIO + more)
    inversion = load_scenario(scenario).controller.inversion
    assert inversion.effectiveness == Constant(kind="constant", b=2.0)
    assert inversion.K == (9.0,)


@pytest.mark.parametrize("turned", [False, True])
def test_set_from_replaces_the_controller_and_other_sets_change_it(scenario, monkeypatch, turned):
    monkeypatch.chdir(scenario.parent)
    sets = ["controller.from=gains.yaml", "controller.inversion.lam=4"]
    controller = load_scenario("paper", sets[::-1] if turned else sets).controller
    assert isinstance(controller, NoNetwork)
    assert (controller.inversion.K, controller.inversion.lam) == ((9.0,), 4.0)


def test_set_takes_a_whole_mapping_with_or_without_from(scenario, monkeypatch):
    monkeypatch.chdir(scenario.parent)
    whole = load_scenario("paper", ["controller={from: gains.yaml, inversion: {K: 2}}"])
    assert (whole.controller.inversion.K, whole.controller.inversion.lam) == ((2.0,), 11.0)
    kind = load_scenario(scenario, ["controller={kind: dnn_mso}"])
    assert kind.controller == DnnMso(kind="dnn_mso")


def test_set_kind_leaves_what_the_new_kind_has_too(scenario):
    controller = load_scenario(scenario, ["controller.kind=dnn_mso"]).controller
    assert isinstance(controller, DnnMso)
    assert controller.inversion.K == (9.0,)


def test_a_controller_is_chosen_by_kind_or_by_file(scenario, monkeypatch):
    monkeypatch.chdir(scenario.parent)
    assert load_scenario("paper", controller="gains.yaml") == load_scenario(
        "paper", ["controller.from=gains.yaml"]
    )
    kind = next(kind for kind in controller_kinds() if kind not in shipped_controllers())
    assert load_scenario("paper", controller=kind).controller.kind == kind
    changed = load_scenario("paper", ["controller.inversion.K=5"], controller="no_network")
    assert changed.controller.inversion.K == (5.0,)


@pytest.mark.parametrize("name", shipped_controllers())
def test_every_shipped_controller_can_be_taken_and_says_how_it_was_found(name):
    from dnnmso_mj.loading.tuned import read_tuned
    from dnnmso_mj.paths import controllers_dir

    load_scenario("paper", [f"controller.from={name}"])
    assert read_tuned(controllers_dir() / f"{name}.yaml").plain()["tuning"]["budget"] > 1


def test_the_log_holds_the_controller_itself(scenario, tmp_path):
    from dnnmso_mj.reading import read_trace
    from dnnmso_mj.run import run_logged

    loaded = load_scenario(scenario, ["duration=0.05"])
    log = run_logged(loaded, tmp_path / "x.mcap").log
    (scenario.parent / "gains.yaml").unlink()
    assert read_trace(log).scenario == loaded


def test_a_sweep_varies_the_tuned_controller(scenario, monkeypatch):
    monkeypatch.chdir(scenario.parent)
    (scenario.parent / "more.yaml").write_text(TUNED.replace("K: 9.0", "K: 5.0"))
    grid = ["controller.from=gains.yaml,more.yaml"]
    plan = plan_sweep("paper", range(2), ["duration=0.05"], grid)
    assert [point.parameters["controller.from"] for point in plan.points] == [
        "gains.yaml",
        "more.yaml",
    ]
    assert [p.scenario.controller.inversion.K for p in plan.points] == [(9.0,), (5.0,)]


def test_the_published_schema_knows_from():
    schema = Draft202012Validator(scenario_schema())
    base = {"name": "x", "reference": {"kind": "sinusoid"}}
    assert schema.is_valid(base | {"controller": {"from": "pid", "inversion": {"K": 3}}})
    assert schema.is_valid(base | {"controller": {"kind": "no_network"}})
    assert not schema.is_valid(base | {"controller": {"from": 3}})
    assert not schema.is_valid(base | {"controller": {"kind": "no_network", "form": "pid"}})
    assert not schema.is_valid(base | {"controller": {}})


# What is refused


def test_a_name_that_is_not_there_names_the_line_and_what_is(scenario):
    scenario.write_text(SCENARIO.replace("gains.yaml", "gain"))
    text = refusal(scenario)
    assert text.startswith(f'{scenario}:4: controller.from = "gain": no such file in ')
    assert "allowed: a YAML file, or one of the shipped controllers: " in text
    assert "\n" not in text
    at = refusal("paper", ["controller.from=gain", "controller.network.bias=false"])
    assert at.startswith('--set controller.from=gain: controller.from = "gain": no such file')
    assert "\n" not in at


def test_a_choice_that_is_nothing_lists_all_that_it_may_be():
    text = refusal("paper", controller="no_netwrk")
    assert 'no controller "no_netwrk"; allowed: a shipped one: ' in text
    assert "a kind with its defaults: " in text
    assert text.endswith("did you mean 'no_network'?")


def test_errors_inside_the_file_name_its_lines(scenario):
    file = scenario.parent / "gains.yaml"
    file.write_text(TUNED.replace("lam:", "lamb:").replace("budget: 20", "budget: 0") + "note: x\n")
    text = refusal(scenario).splitlines()
    assert text[0].startswith(f"{file}:5: controller.inversion.lamb = 11.0: unknown key; allowed:")
    assert text[0].endswith("did you mean 'lam'?")
    assert text[1].startswith(f"{file}:12: tuning.budget = 0: is out of range; allowed: a whole")
    assert text[2] == f'{file}:20: note = "x": unknown key; allowed: controller, tuning'


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("", ":1: the file holds no tuned controller; allowed: the keys controller, tuning"),
        ("kind: no_network\n", ":1: controller: missing key; allowed: keys with kind one of"),
        ("controller: {from: x}\n", ":1: controller.kind: missing key; allowed: one of"),
        ("controller: [\n", "not valid YAML"),
        (TUNED.replace("  version: 0.1.0\n", ""), "tuning.version: missing key; allowed: text"),
    ],
)
def test_a_file_that_is_no_tuned_controller_is_refused(scenario, content, problem):
    (scenario.parent / "gains.yaml").write_text(content)
    assert problem in refusal(scenario)


def test_a_value_that_does_not_fit_the_scenario_has_the_place_it_came_from(scenario):
    file = scenario.parent / "gains.yaml"
    file.write_text(TUNED.replace("K: 9.0", "K: [9, 9, 9]"))
    assert refusal(scenario).startswith(f"{file}:4: controller.inversion.K = [9, 9, 9]: has 3")
    whole = refusal("paper", [f"controller.from={file}"])
    assert whole.startswith(f"{file}:4: controller.inversion.K")
    scenario.write_text(f"{SCENARIO}  inversion:\n    K: [1, 2, 3]\n")
    assert refusal(scenario).startswith(f"{scenario}:6: controller.inversion.K = [1, 2, 3]")
    one = refusal(scenario, ["controller.inversion.K=[1, 2, 3]"])
    assert one.startswith("--set controller.inversion.K=[1, 2, 3]: controller.inversion.K")


def test_another_kind_beside_from_is_refused(scenario):
    scenario.write_text(f"{SCENARIO}  kind: dnn_mso\n")
    text = refusal(scenario)
    assert text.startswith(f'{scenario}:5: controller.kind = "dnn_mso": gains.yaml is no_network')
    assert text.endswith("allowed: from without kind")


def test_from_that_is_no_text_is_refused(scenario):
    scenario.write_text(SCENARIO.replace("gains.yaml", "[a]"))
    assert ':4: controller.from = ["a"]: is no name; allowed: ' in refusal(scenario)


def test_a_key_of_another_kind_is_refused(scenario):
    scenario.write_text(f"{SCENARIO}  network: {{bias: false}}\n")
    text = refusal(scenario)
    assert text.startswith(f"{scenario}:5: controller.network = {{bias: false}}: unknown key")


def test_the_command_line_takes_a_controller_by_path(scenario):
    options = ("--set", "duration=0.1", "--no-plot", "--json")
    done = dnnmso(
        "run", "paper", "--set", "controller.from=gains.yaml", *options, cwd=scenario.parent
    )
    assert done.returncode == 0, done.stderr
