"""Row 8 in its short form, its checker against what it must notice, and reach of files."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from soak.hostile_files import Place, judge, prepare
from soak.proof import prove
from soak.tally import Tally
from soak.watched import Outcome, watch

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.mjcf import gate
from dnnmso_mj.paths import find_model

TEXT = "name: mine\nduration: 0.01\nreference: {kind: sinusoid}\ncontroller: {kind: pd}\n"


def test_hostile_files_are_refused_and_nothing_outside_is_touched(tmp_path: Path) -> None:
    prove(8, tmp_path)


@pytest.fixture
def place(tmp_path: Path):
    made = Place(tmp_path)
    yield made
    made.close()


def tried(place: Place, action: Callable[[], object]) -> Tally:
    tally = Tally()
    judge(tally, "control", watch(action, place.canaries, seconds=20.0), "plant.model")
    return tally


def refuse(*_: object) -> None:
    raise ScenarioError("plant.model: no; allowed: yes")


def test_the_checker_lets_a_plain_refusal_pass(place: Place) -> None:
    assert tried(place, refuse).survived == 1


def test_the_checker_notices_who_reads_a_canary_even_if_refused_then(place: Place) -> None:
    tally = tried(place, lambda: refuse((place.outside / "secret.xml").read_bytes()))
    assert "opened outside" in tally.let_in[0]
    link = place.inside / "links" / "secret.stl"
    assert "opened outside" in tried(place, lambda: refuse(link.open())).let_in[0]


def test_the_checker_notices_who_writes_outside(place: Place) -> None:
    new = place.outside / "new"
    assert "opened outside" in tried(place, lambda: refuse(new.write_text("x"))).let_in[0]
    assert not place.canaries.unchanged()


def test_the_checker_notices_what_is_accepted(place: Place) -> None:
    assert "accepted" in tried(place, lambda: None).let_in[0]


def test_the_checker_notices_another_error_and_a_process_that_ends(place: Place) -> None:
    assert "ZeroDivisionError" in tried(place, lambda: 1 / 0).lost[0]
    assert "SystemExit" in tried(place, exit).lost[0]


def test_the_checker_notices_a_hang(place: Place) -> None:
    outcome = watch(lambda: time.sleep(60), place.canaries, seconds=0.2)
    assert outcome.error == "hang"


def test_the_checker_notices_memory(place: Place) -> None:
    assert "MB" in tried(place, lambda: refuse(bytearray(300 << 20))).lost[0]


def test_the_checker_notices_time_and_poor_messages() -> None:
    for outcome, problem in (
        (Outcome("ScenarioError", True, "plant.model: allowed: x", seconds=1.5), "1.50 s"),
        (Outcome("ScenarioError", True, "no; allowed: x"), "does not name"),
        (Outcome("ScenarioError", True, "plant.model: no"), "what is allowed"),
        (Outcome("ScenarioError", True, "plant.model: \x1b allowed"), "control"),
        (Outcome("ScenarioError", True, "plant.model: allowed canary-marker"), "another file"),
        (Outcome("ScenarioError", True, "plant.model allowed" + "x" * 3000), "too long"),
    ):
        tally = Tally()
        judge(tally, "control", outcome, "plant.model")
        assert problem in tally.lost[0]


# --- which files are in reach -------------------------------------------------------------------


def test_a_scenario_may_name_files_beside_it_and_in_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    project, other = tmp_path / "project", tmp_path / "other"
    for folder in (project / "scenarios" / "arms", project / "models", other):
        folder.mkdir(parents=True)
    arm = find_model("two_link").read_text()
    for model in ("scenarios/arms/a.xml", "models/a.xml"):
        (project / model).write_text(arm)
    scenario = project / "scenarios" / "mine.yaml"
    scenario.write_text(TEXT + "plant: {model: arms/a.xml}\n")
    monkeypatch.chdir(other)
    assert load_scenario(scenario).plant.model == str(project / "scenarios/arms/a.xml")

    scenario.write_text(TEXT + "plant: {model: ../models/a.xml}\n")
    with pytest.raises(ScenarioError, match=r"mine\.yaml:5: plant\.model = .* is out of reach"):
        load_scenario(scenario)
    assert load_scenario(scenario, trust=True).plant.model == str(project / "models/a.xml")
    named = f"plant.model={json.dumps(str(project / 'models/a.xml'))}"
    assert load_scenario(scenario, [named]).plant.model == str(project / "models/a.xml")
    monkeypatch.chdir(project)
    assert load_scenario(scenario).plant.model == str(project / "models/a.xml")


def test_a_model_of_a_package_is_not_a_way_out_of_it(tmp_path: Path) -> None:
    (tmp_path / "a.xml").write_text(find_model("two_link").read_text())
    up = "../" * 30 + str(tmp_path)[1:]
    with pytest.raises(ScenarioError, match="no model"):
        find_model(f"dnnmso_mj:{up}/a.xml", tmp_path)


def test_what_a_set_names_may_not_name_on(tmp_path: Path) -> None:
    """A tuned controller from anywhere, named by the user, that names a file elsewhere."""
    tuned, elsewhere = tmp_path / "a" / "tuned.yaml", tmp_path / "b" / "law.onnx"
    for path in (tuned, elsewhere):
        path.parent.mkdir()
    tuned.write_text(f"controller: {{kind: policy, file: {elsewhere}}}\n")
    with pytest.raises(ScenarioError, match=r"tuned\.yaml:1: controller\.file .* out of reach"):
        load_scenario("paper", [f"controller.from={tuned}"])
    sets = [f"controller.from={tuned}", f"controller.file={elsewhere}"]
    assert load_scenario("paper", sets).controller.file == str(elsewhere)


def test_torchscript_is_code_and_onnx_is_not(tmp_path: Path) -> None:
    for name in ("law.pt", "law.ts"):
        with pytest.raises(ScenarioError, match=r"law\.[pt]s?.*: runs code of its own"):
            load_scenario("paper", [f"controller={{kind: policy, file: {tmp_path}/{name}}}"])
    chosen = f"controller={{kind: policy, file: {tmp_path}/law.onnx}}"
    assert load_scenario("paper", [chosen]).controller.file == f"{tmp_path}/law.onnx"


def test_preparing_reads_what_a_person_names(place: Place) -> None:
    """The negative control of the whole row: the canary that is named is noticed."""
    file = place.inside / "mine.yaml"
    file.write_text(TEXT)
    sets = (f"plant.model={json.dumps(str(place.outside / 'secret.xml'))}",)
    outcome = watch(lambda: prepare(file, sets, place.here), place.canaries)
    assert (outcome.error, outcome.text) == ("", "")
    assert any("secret.xml" in name for name in outcome.touched)


def test_many_problems_are_told_in_time(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(TEXT + "".join(f"key{k}: 1\n" for k in range(5000)))
    before = time.process_time()
    with pytest.raises(ScenarioError, match=r"… and 4900 more$"):
        load_scenario(file)
    assert time.process_time() - before < 1.0


def test_the_gate_takes_the_largest_that_it_allows_in_time() -> None:
    bodies = "<body><joint/><geom size='1'/></body>" * 1000
    before = time.process_time()
    gate(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    assert time.process_time() - before < 1.0
