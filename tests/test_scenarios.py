"""Every shipped scenario: it loads, says what it is, and keeps to the schema that it names."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from pydantic import BaseModel
from ruamel.yaml import YAML

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.loading import list_scenarios, load_scenario, scenario_schema
from dnnmso_mj.paths import models_dir, scenarios_dir
from dnnmso_mj.scenario import (
    ClassicalMso,
    Constant,
    DnnMso,
    NoNetwork,
    Scenario,
    Setpoint,
    Sinusoid,
    Waypoints,
)
from dnnmso_mj.simulation import simulate

FILES = sorted(scenarios_dir().glob("*.yaml"))
NAMES = [file.stem for file in FILES]
every_scenario = pytest.mark.parametrize("name", NAMES)


def raw(name: str) -> Any:
    return YAML(typ="safe", pure=True).load(scenarios_dir() / f"{name}.yaml")


def test_the_promised_scenarios_ship() -> None:
    promised = {"paper", "paper_no_network", "model_free", "as_printed", "classical_mso"}
    assert promised | {"rods", "fast", "setpoint", "waypoints"} <= set(NAMES)


@every_scenario
def test_it_loads_without_a_warning_and_is_called_like_its_file(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scenario = load_scenario(name)
    assert scenario.name == name
    assert scenario == load_scenario(scenarios_dir() / f"{name}.yaml")
    assert (models_dir() / f"{scenario.plant.model}.xml").is_file()


@every_scenario
def test_it_survives_a_round_trip_through_json(name: str) -> None:
    scenario = load_scenario(name)
    assert Scenario.model_validate_json(scenario.model_dump_json()) == scenario


@every_scenario
def test_its_header_names_the_schema_and_says_what_it_shows(name: str) -> None:
    lines = (scenarios_dir() / f"{name}.yaml").read_text().splitlines()
    assert lines[0] == "# yaml-language-server: $schema=scenario.schema.json"
    header = lines[1 : next(k for k, line in enumerate(lines) if not line.startswith("#"))]
    assert len(" ".join(header)) > 80
    assert max(map(len, lines)) <= 100


@every_scenario
def test_every_number_has_a_unit_or_a_reason_beside_it(name: str) -> None:
    text = (scenarios_dir() / f"{name}.yaml").read_text()
    numbers = re.findall(r"^ *\w+: *[\[{]?-?\d.*$", text, re.MULTILINE)
    assert [line for line in numbers if "#" not in line] == []


@every_scenario
def test_it_starts_near_its_reference(name: str) -> None:
    scenario = load_scenario(name)
    match scenario.reference:
        case Setpoint() as ref:
            assert scenario.initial.q == ref.start
            assert ref.start_time + ref.blend_time < scenario.duration / 2
        case Waypoints() as ref:
            assert scenario.initial.q == ref.points[0]
            assert len(ref.points) >= 4
            assert ref.times[-1] <= scenario.duration


def test_the_list_has_every_scenario_with_a_description() -> None:
    listed = list_scenarios()
    literature = sorted((scenarios_dir() / "literature").glob("*.yaml"))
    names = [*NAMES, *(f"literature/{file.stem}" for file in literature)]
    assert [name for name, _ in listed] == names
    assert all(len(description) > 20 for _, description in listed)
    assert len({description for _, description in listed}) == len(listed)


def test_the_paper_scenario_has_the_papers_numbers() -> None:
    paper = load_scenario("paper")
    assert (paper.plant.masses, paper.plant.lengths) == ((1.0, 2.3), (1.0, 1.0))
    assert (paper.initial.q, paper.initial.qd) == ((0.5, 0.5), (0.0,))
    assert (paper.duration, paper.dt, paper.n_ticks) == (10.0, 0.001, 10_000)
    assert isinstance(paper.reference, Sinusoid)
    assert paper.reference.phase == (0.0, 1.5707963267948966)
    assert (paper.reference.amplitude, paper.reference.frequency) == ((1.0,), (0.5,))
    assert isinstance(paper.controller, DnnMso)
    assert paper.controller.inversion.K == (7.5,)
    assert paper.controller.observer.K2 == (30.0,)
    network, madam = paper.controller.network, paper.controller.madam
    assert (len(network.hidden) + 1, network.activation, network.init_scale) == (4, "sigmoid", 3.6)
    assert (madam.eta, madam.eta_max, madam.sigma_max, madam.beta) == (0.001, 0.1, 1250.0, 0.999)


def left_out(part: BaseModel, path: str = "") -> Iterator[str]:
    for name in type(part).model_fields:
        value = getattr(part, name)
        if name not in part.model_fields_set:
            yield f"{path}{name}"
        elif isinstance(value, BaseModel):
            yield from left_out(value, f"{path}{name}.")


def test_the_paper_scenario_spells_out_every_value() -> None:
    assert list(left_out(load_scenario("paper"))) == []
    assert "plant.links" in set(left_out(load_scenario("classical_mso")))


def test_each_variant_differs_from_the_paper_in_its_point() -> None:
    paper = load_scenario("paper")
    assert isinstance(load_scenario("paper_no_network").controller, NoNetwork)
    effectiveness = load_scenario("model_free").controller.inversion.effectiveness
    assert effectiveness == Constant(kind="constant", b=1.0)
    assert load_scenario("as_printed").controller.observer.feedback == "as_printed"
    assert load_scenario("rods").plant.links == "rod"
    classical = load_scenario("classical_mso")
    assert isinstance(classical.controller, ClassicalMso)
    assert classical.controller.inversion.effectiveness.masses != classical.plant.masses
    for name in ("paper_no_network", "model_free", "as_printed", "classical_mso", "rods"):
        variant = load_scenario(name)
        assert (variant.reference, variant.initial) == (paper.reference, paper.initial), name
        assert (variant.duration, variant.dt) == (paper.duration, paper.dt), name


def test_the_schema_file_is_in_step_with_the_models() -> None:
    expected = json.dumps(scenario_schema(), indent=2) + "\n"
    assert (scenarios_dir() / "scenario.schema.json").read_text() == expected


def test_the_schema_is_a_valid_schema_that_describes_every_key() -> None:
    schema = scenario_schema()
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    Draft202012Validator.check_schema(schema)
    assert set(schema["required"]) == {"name", "reference", "controller"}
    parts = {"Scenario": schema, **schema["$defs"]}
    mute = [
        f"{name}.{key}"
        for name, part in parts.items()
        for key, value in part["properties"].items()
        if not value.get("description")
    ]
    assert mute == []
    assert "(N·m)" in schema["$defs"]["Imperfections"]["properties"]["torque_limit"]["description"]
    assert all(part["additionalProperties"] is False for part in parts.values())


@every_scenario
def test_it_conforms_to_the_schema(name: str) -> None:
    errors = Draft202012Validator(scenario_schema()).iter_errors(raw(name))
    assert [error.message for error in errors] == []


WRONG = {
    "unknown key": ("plant", {"gravty": 9.81}),
    "unknown key at the top": ("plnt", {}),
    "unknown kind": ("reference", {"kind": "sinusiod"}),
    "key of another kind": ("reference", {"kind": "sinusoid", "goal": [1.0, 1.0]}),
    "missing key of a kind": ("reference", {"kind": "setpoint", "start": [0.0, 0.0]}),
    "text for a number": ("duration", "10"),
    "out of range": ("dt", -0.001),
    "a fraction for a count": ("seed", 0.5),
    "unknown choice": ("plant", {"integrator": "rk5"}),
    "empty list": ("plant", {"masses": []}),
    "text in a list": ("initial", {"q": [0.5, "x"]}),
    "too few points": ("reference", {"kind": "waypoints", "times": [0.0], "points": [[0.0, 0.0]]}),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_the_schema_refuses(wrong: str) -> None:
    key, value = WRONG[wrong]
    data = {**raw("paper"), key: value}
    assert not Draft202012Validator(scenario_schema()).is_valid(data)


@pytest.mark.parametrize("value", [7.5, 7, [7.5, 7.5, 30, 30]])
def test_the_schema_takes_one_number_or_a_list_where_the_loader_does(
    value: Any, tmp_path: Path
) -> None:
    data = raw("paper")
    data["controller"]["inversion"]["K"] = value
    assert Draft202012Validator(scenario_schema()).is_valid(data)
    file = tmp_path / "s.yaml"
    file.write_text(json.dumps(data))
    found = load_scenario(file).controller.inversion.K
    assert list(found) == (value if isinstance(value, list) else [value])


@pytest.mark.parametrize(
    ("name", "override", "message"),
    [
        ("paper", "controller.observer.K2=2000", "K2 < 2/dt = 2000"),
        ("classical_mso", "controller.network.outputs=kinematic", "allowed: full"),
        ("paper", "controller.madam.sigma_max=1e-300", "from 0.001 to 1000000"),
        ("paper", "controller.network.init_scale=1e-300", "from 0.001 to 1000"),
        ("paper", "controller.network.output_scale=1e300", "from 0.001 to 1000"),
    ],
)
def test_values_that_cannot_work_together_are_refused(name, override, message):
    with pytest.raises(ScenarioError, match=message):
        load_scenario(name, [override])


@pytest.mark.parametrize("name", ["paper", "classical_mso"])
@pytest.mark.parametrize(
    ("precision", "eta", "beta", "least"),
    [
        ("float64", 1e-17, 1 - 2**-53, r"2\^-52 = 2\.2e-16"),
        ("float32", 1e-7, 1 - 1e-8, r"2\^-23 = 1\.2e-07"),
    ],
)
def test_learning_that_would_be_rounded_away_is_refused(name, precision, eta, beta, least):
    arithmetic = f"controller.network.precision={precision}"
    for key, value in (("eta", eta), ("beta", beta)):
        with pytest.raises(ScenarioError, match=rf"madam\.{key} .* {least}, what {precision} re"):
            load_scenario(name, [arithmetic, f"controller.madam.{key}={value!r}"])
        if precision == "float32":
            fine = "controller.network.precision=float64"
            load_scenario(name, [fine, f"controller.madam.{key}={value!r}"])


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize(
    "extremes",
    [
        ("network.init_scale=1e-3", "network.output_scale=1e-3", "madam.sigma_max=1e-3"),
        ("network.init_scale=1e-3", "network.output_scale=1e-3", "madam.eta=2e-7"),
        ("network.init_scale=1e3", "network.output_scale=1e3", "madam.sigma_max=1e6"),
    ],
)
def test_the_extremes_of_what_is_allowed_stay_numbers(precision, extremes):
    sets = [f"controller.{item}" for item in (*extremes, f"network.precision={precision}")]
    trace = simulate(load_scenario("paper", [*sets, "duration=0.1"]))
    # Weights of a thousand may well drive the arm away; the learning itself must stay finite.
    assert trace.info.status == "ok" or trace.info.reason.startswith("|")
    assert len(trace) > 0
    assert np.isfinite(trace["update_ratio"]).all()
