"""`dnnmso new`, `controllers` and `scenarios`: what is written is what it was made from."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import pytest
from pydantic import BaseModel
from ruamel.yaml import YAML

from dnnmso_mj import catalogue
from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.loading import controller_kinds, load_scenario
from dnnmso_mj.margins.rows import is_model_free
from dnnmso_mj.new_scenario import new_scenario
from dnnmso_mj.paths import scenario_names, scenarios_dir, shipped_controllers

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("source", scenario_names())
def test_every_shipped_scenario_comes_back_from_its_copy(source, tmp_path):
    file = new_scenario("mine", source, out=tmp_path / "mine.yaml")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_scenario(file) == load_scenario(source).model_copy(update={"name": "mine"})


@pytest.mark.parametrize("controller", [*controller_kinds(), *shipped_controllers()])
def test_every_controller_comes_back(controller, tmp_path):
    file = new_scenario("mine", "paper", controller, tmp_path / "mine.yaml")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        wanted = load_scenario("paper", controller=controller)
        assert load_scenario(file) == wanted.model_copy(update={"name": "mine"})


def test_every_key_is_there_with_its_meaning_its_default_and_its_range(tmp_path):
    file = new_scenario("mine", "hard_delay", out=tmp_path / "mine.yaml")
    text = file.read_text(encoding="utf-8")
    flat = " ".join(text.replace("#", " ").split())
    for part in parts(load_scenario(file)):
        for key, field in type(part).model_fields.items():
            assert f"{key}:" in text, key
            if key != "kind":
                meaning = str(field.description).split("\n")[0].rstrip(".")
                assert " ".join(meaning.split()) in flat, key
    gravity = text.split("\n  gravity:")[0].splitlines()[-1]
    assert gravity.strip() == (
        "# Gravitational acceleration, along -z (m/s²). Default 9.81; allowed: a number >= 0."
    )
    assert "Allowed: adrc, backstepping, " in flat
    paths = ("$schema=", str(tmp_path))  # these are as long as they are
    lines = [line for line in text.splitlines() if not any(path in line for path in paths)]
    assert max(map(len, lines)) <= 100


def parts(part: BaseModel) -> list[BaseModel]:
    """A part and all below it."""
    found = [part]
    for _, value in part:
        for item in value if isinstance(value, tuple) else (value,):
            found += parts(item) if isinstance(item, BaseModel) else []
    return found


def test_an_editor_finds_the_schema_from_where_the_file_is(tmp_path, monkeypatch):
    file = new_scenario("mine", out=tmp_path / "a b" / "mine.yaml")
    first = file.read_text(encoding="utf-8").splitlines()[0]
    assert first == f"# yaml-language-server: $schema={scenarios_dir()}/scenario.schema.json"
    monkeypatch.chdir(scenarios_dir().parent)
    from dnnmso_mj.new_scenario import scenario_text

    inside = scenario_text(load_scenario("paper"), Path("scenarios/literature/x.yaml"), "paper")
    assert inside.startswith("# yaml-language-server: $schema=../scenario.schema.json\n")


def test_a_list_without_entries_says_what_may_stand_in_it(tmp_path):
    text = new_scenario("mine", out=tmp_path / "mine.yaml").read_text(encoding="utf-8")
    flat = " ".join(text.replace("#", " ").split())
    assert "kind: push with at, duration, torque, force" in flat
    assert YAML(typ="safe", pure=True).load(text)["events"] == []


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("a/b", {}, 'NAME = "a/b": is not a name; allowed: Letters, digits'),
        ("paper", {}, "NAME = paper: a scenario that ships; allowed: another name, as in my_paper"),
        ("mine", {"source": "papr"}, "papr: no such file; allowed: a YAML file, or one of"),
        ("mine", {"controller": "pidd"}, 'no controller "pidd"; allowed: '),
        ("mine", {"out": Path("/proc/x.yaml")}, "/proc/x.yaml: cannot be written: "),
    ],
)
def test_what_cannot_be_written_is_refused(name, options, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ScenarioError) as refused:
        new_scenario(name, **options)
    assert str(refused.value).startswith(message)
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_is_there_is_left_as_it_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = new_scenario("mine.yaml")
    assert file == Path("mine.yaml")
    file.write_text("mine")
    with pytest.raises(ScenarioError, match=r"mine\.yaml: exists; allowed: another NAME"):
        new_scenario("mine")
    assert file.read_text() == "mine"


def test_the_catalogue_says_of_every_kind_what_it_is_told():
    found = {item.kind: item for item in catalogue.kinds()}
    assert set(found) - {"external", "policy"} == set(controller_kinds())
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for kind in controller_kinds():
        item = found[kind]
        controller = load_scenario("paper", controller=kind).controller
        form_only = "not its numbers" in item.told
        assert (item.told == "nothing") == (is_model_free(controller) and not form_only), kind
        row = next(line for line in readme.splitlines() if line.startswith(f"| `{kind}` |"))
        source = row.split("|")[3]
        assert item.source.split(",")[0].removeprefix("ours: ") in source, kind
    assert [item.name for item in catalogue.tuned_controllers()] == shipped_controllers()
    assert all(item.trials and item.scenario for item in catalogue.tuned_controllers())


def test_the_catalogue_says_what_is_in_a_scenario():
    found = {item.name: item for item in catalogue.shipped_scenarios()}
    assert list(found) == scenario_names()
    hard = found["hard"]
    assert (hard.controller, hard.reference, hard.duration) == ("dnn_mso_replay", "sinusoid", 40.0)
    assert hard.imperfections == ("torque_limit", "position_noise", "velocity_noise")
    assert hard.events == ("payload",)
    assert found["paper"].imperfections == found["paper"].events == ()


def test_lists_are_the_same_as_text_and_as_json(capsys):
    from dnnmso_mj.cli.scenarios import controllers, scenarios

    for command in (controllers, scenarios):
        command(as_json=True)
        document = json.loads(capsys.readouterr().out)
        command()
        text = capsys.readouterr().out
        items = document if isinstance(document, list) else document["kinds"] + document["tuned"]
        assert len(items) > 10
        for item in items:
            name = item.get("name") or item["kind"]
            line = next(line for line in text.splitlines() if line.split()[:1] == [name])
            told = item.get("description") or item.get("source") or item["kind"]
            assert told in line  # in one line, whatever its length, where nobody has a terminal
