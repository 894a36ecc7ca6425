"""What the loader takes, what it refuses and in which words, and what `--set` does."""

from __future__ import annotations

import json
import os
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dnnmso_mj.dynamics import TwoLink
from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.loading import ScenarioWarning, load_scenario
from dnnmso_mj.loading.advice import stretched_load
from dnnmso_mj.loading.shape import Shape
from dnnmso_mj.paths import models_dir, scenarios_dir
from dnnmso_mj.scenario import Controller, DnnMso, NoNetwork, Plant, Scenario, Setpoint, Sinusoid
from dnnmso_mj.simulation import simulate

MINIMAL = "name: x\nreference:\n  kind: sinusoid\ncontroller:\n  kind: dnn_mso\n"  # lines 1 to 5
PAPER = (scenarios_dir() / "paper.yaml").read_text()
TOP = ", ".join(Scenario.model_fields)
SPECS = get_args(get_args(Controller)[0])
KINDS = ", ".join(sorted(get_args(spec.model_fields["kind"].annotation)[0] for spec in SPECS))

Load = Callable[..., Scenario]
Refusal = Callable[..., str]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def load(text: str | bytes, *overrides: str) -> Scenario:
    """Load `text` as the file s.yaml."""
    Path("s.yaml").write_bytes(text.encode() if isinstance(text, str) else text)
    return load_scenario("s.yaml", overrides)


def refusal(text: str | bytes, *overrides: str) -> str:
    """The message with which `text` is refused; refusing must leave nothing behind."""
    with pytest.raises(ScenarioError) as caught:
        load(text, *overrides)
    assert os.listdir() == ["s.yaml"]
    return str(caught.value)


# --- what is taken


def test_a_minimal_scenario_has_the_papers_defaults() -> None:
    scenario = load(MINIMAL)
    assert scenario.plant.masses == (1.0, 2.3)
    assert isinstance(scenario.controller, DnnMso)
    assert scenario.controller.madam.eta == 0.001


@pytest.mark.parametrize(
    ("text", "value"),
    [("1e-3", 0.001), ("1E1", 10.0), (".5", 0.5), ("3", 3.0), ("0x10", 16.0), ("0o17", 15.0)],
)
def test_numbers_are_those_of_yaml_1_2(text: str, value: float) -> None:
    assert load(f"{MINIMAL}plant: {{gravity: {text}}}\n").plant.gravity == value


@pytest.mark.parametrize("text", ["no", "on", "Yes", "1_000", "1:30", "0b11", '"9.81"', "010x"])
def test_words_that_only_yaml_1_1_converts_stay_text(text: str) -> None:
    plain = text.strip('"')
    assert f'plant.gravity = "{plain}": is text' in refusal(f"{MINIMAL}plant:\n  gravity: {text}\n")


def test_anchors_and_aliases_are_copied() -> None:
    text = MINIMAL + "plant: {masses: &v [1, 2], lengths: *v}\ninitial: {q: *v, qd: *v}\n"
    scenario = load(text, "initial.q.0=7")
    assert scenario.initial.q == (7.0, 2.0)
    assert scenario.initial.qd == (1.0, 2.0)


def test_a_byte_order_mark_and_windows_line_ends_are_no_matter() -> None:
    text = "\ufeff" + PAPER.replace("\n", "\r\n")
    assert load(text.encode()) == load_scenario("paper")


# --- where a model is


def test_a_model_beside_the_scenario_is_found_later_from_anywhere(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "arms").mkdir()
    arm = folder / "arms" / "mine.xml"
    arm.write_text("<mujoco/>")
    (folder / "arms" / "s.yaml").write_text(MINIMAL + "plant: {model: mine.xml}\n")
    monkeypatch.chdir("/")
    assert load_scenario(folder / "arms" / "s.yaml").plant.model == str(arm)


@pytest.mark.parametrize("rest", ["", "plant: {gravity: 1}\n"])
def test_a_model_of_ones_own_does_not_get_the_papers_masses(folder: Path, rest: str) -> None:
    (folder / "arm.xml").write_text("<mujoco/>")
    for scenario in (
        load(MINIMAL + "plant: {model: arm.xml}\n"),
        load(MINIMAL + rest, "plant.model=arm.xml"),
    ):
        assert (scenario.plant.masses, scenario.plant.lengths) == (None, None)
    given = load(MINIMAL + "plant: {model: arm.xml, masses: [1, 2], lengths: [3, 4]}\n")
    assert (given.plant.masses, given.plant.lengths) == ((1.0, 2.0), (3.0, 4.0))
    text = MINIMAL + "plant: {model: arm.xml, masses: [1, 2]}\n"
    with pytest.raises(ScenarioError, match=r"s\.yaml:6: plant\.masses = \[1, 2\]: stands alone"):
        load(text)


def test_a_model_in_an_override_is_relative_to_the_current_folder(folder: Path) -> None:
    (folder / "mine.xml").write_text("<mujoco/>")
    assert load_scenario("paper", ["plant.model=mine.xml"]).plant.model == str(folder / "mine.xml")


def test_a_path_to_a_shipped_model_becomes_its_name() -> None:
    path = models_dir() / "two_link.xml"
    assert load(f"{MINIMAL}plant: {{model: '{path}'}}\n").plant.model == "two_link"


# --- what is refused: one line, at the end of MINIMAL or in its place

REFUSED = {
    "unknown key": (
        "plant:\n  gravty: 9\n",
        "7: plant.gravty = 9: unknown key; allowed: model, links, masses, lengths, gravity, "
        "integrator; did you mean 'gravity'?",
    ),
    "unknown key at the top": ("plnt: {}\n", f"6: plnt = {{}}: unknown key; allowed: {TOP}; did"),
    "unknown key of a kind": (
        "  madm: {}\n",
        "6: controller.madm = {}: unknown key; allowed: kind, inversion, observer, network, "
        "madam, optimizer; did you mean 'madam'?",
    ),
    "unknown choice": (
        "plant: {integrator: RK5}\n",
        '6: plant.integrator = "RK5": is none of the choices; allowed: one of: rk4, euler, '
        "implicitfast; did you mean 'rk4'?",
    ),
    "no key but a number": ("1: 2\n", f"6: 1 = 2: unknown key; allowed: {TOP}"),
    "empty key": ('"": 2\n', f"6: '' = 2: unknown key; allowed: {TOP}"),
    "text for a number": ('duration: "10"\n', '6: duration = "10": is text; allowed: a number > 0'),
    "true for a number": (
        "plant: {gravity: true}\n",
        "6: plant.gravity = true: is true or false; allowed: a number >= 0",
    ),
    "true for a vector": (
        "initial: {qd: true}\n",
        "6: initial.qd = true: is true or false; allowed: a number or a list of numbers",
    ),
    "number for a switch": (
        "  network: {bias: 1}\n",
        "6: controller.network.bias = 1: is a whole number; allowed: true or false",
    ),
    "fraction for a count": (
        "  network: {hidden: [64, 1.5]}\n",
        "6: controller.network.hidden.1 = 1.5: is not written as a whole number; allowed: "
        "a whole number from 1 to 4096",
    ),
    "list for a part": ("plant: [1]\n", "6: plant = [1]: is a list; allowed: the keys model, "),
    "nothing for a part": ("plant:\n", "6: plant = null: is empty; allowed: the keys model, "),
    "text in a list": (
        "initial:\n  q:\n    - 0.5\n    - x\n",
        '9: initial.q.1 = "x": is text; allowed: a number',
    ),
    "group for a vector": (
        "initial: {q: {a: 1}}\n",
        "6: initial.q = {a: 1}: is a group of keys; allowed: a list of numbers",
    ),
    "empty list": (
        "plant:\n  masses: []\n",
        "7: plant.masses = []: is an empty list; allowed: a list of numbers > 0 or null",
    ),
    "too long a list": (
        f"  network: {{hidden: [{'1, ' * 33}]}}\n",
        "6: controller.network.hidden = [1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, "
        "… , 1, 1, 1]: has 33 entries; allowed: a list of 1 to 32 whole numbers from 1 to 4096",
    ),
    "not a number": (
        "plant:\n  masses: [1, .nan]\n",
        "7: plant.masses.1 = .nan: is not finite; allowed: a number > 0",
    ),
    "infinity": ("duration: -.inf\n", "6: duration = -.inf: is not finite; allowed: a number > 0"),
    "overflow": ("duration: 1e999\n", "6: duration = .inf: is not finite; allowed: a number > 0"),
    "one infinite number for all": (
        "initial: {qd: .inf}\n",
        "6: initial.qd = .inf: is not finite; allowed: a number or a list of numbers",
    ),
    "out of range": (
        "plant: {gravity: -1}\n",
        "6: plant.gravity = -1: is out of range; allowed: a number >= 0",
    ),
    "out of two bounds": (
        "  madam: {beta: 1}\n",
        "6: controller.madam.beta = 1: is out of range; allowed: a number >= 0 and < 1",
    ),
    "not a name": ("", '1: name = "x y": is not a name; allowed: a name (Letters, digits, '),
    "half a character": ("", '1: name = "\\ud800": holds half a character (a surrogate); allowed'),
    "unknown kind": (
        "",
        '3: reference.kind = "sinusiod": is none of the choices; allowed: one of: '
        "exp_sinusoid, external, setpoint, sinusoid, waypoints; did you mean 'sinusoid'?",
    ),
    "no kind": (
        "",
        f"4: controller.kind: missing key; allowed: one of: {KINDS}",
    ),
    "kind of a wrong type": ("", "3: reference.kind = [1]: is a list; allowed: one of: exp_"),
    "kind of the inner union": (
        "  inversion:\n    effectiveness: {kind: const}\n",
        '7: controller.inversion.effectiveness.kind = "const": is none of the choices; allowed: '
        "one of: constant, inertia; did you mean 'constant'?",
    ),
    "range in the inner union": (
        "  inversion:\n    effectiveness:\n      kind: constant\n      b: 0\n",
        "9: controller.inversion.effectiveness.b = 0: is out of range; allowed: a number > 0",
    ),
    "half steps": (
        "duration: 1.0005\n",
        "6: duration = 1.0005: is 1000.5 steps of dt = 0.001; allowed: a whole number of steps "
        "from 1 to 100000000",
    ),
    "too many steps": ("duration: 1e308\n", "6: duration = 1e+308: is inf steps of dt = 0.001; "),
    "masses alone": (
        "plant:\n  masses: null\n",
        "6: plant.lengths = [1.0, 1.0] (the default): stands alone; allowed: masses and lengths "
        "both, or both null",
    ),
    "one length too few": (
        "plant:\n  lengths: [1]\n",
        "7: plant.lengths = [1]: has 1 entry; allowed: 2, as many as masses",
    ),
    "wrong length": (
        "initial:\n  qd: [0, 0, 0]\n",
        "7: initial.qd = [0, 0, 0]: has 3 entries; allowed: 1 or 2, since initial.q has 2 entries",
    ),
    "eta above its maximum": (
        "  madam: {eta: 0.5}\n",
        "6: controller.madam.eta_max = 0.1 (the default): is below eta = 0.5; allowed: "
        "eta_max >= eta",
    ),
    "too wide a network": (
        "  network: {hidden: [4096, 4096]}\n",
        "6: controller.network.hidden = [4096, 4096]: makes 16777216 weights; allowed: at most "
        "10000000 between hidden layers",
    ),
    "ragged slack matrix": (
        "  inversion:\n    slack_matrix: [[1, 0], [0]]\n",
        "7: controller.inversion.slack_matrix = [[1, 0], [0]]: has rows that do not fit; allowed: "
        "2n rows of n numbers each",
    ),
    "singular slack matrix": (
        "  inversion: {slack_matrix: [[1, 2], [2, 4], [1, 0], [0, 1]]}\n",
        "6: controller.inversion.slack_matrix = [[1, 2], [2, 4], [1, 0], [0, 1]]: leaves [B B_s] "
        "without an inverse; allowed: regular upper n rows",
    ),
    "unknown model": (
        "plant:\n  model: tow_link\n",
        '7: plant.model = "tow_link": no model "tow_link" in ',
    ),
}
INSTEAD = {
    "not a name": MINIMAL.replace("name: x", "name: x y"),
    "half a character": MINIMAL.replace("name: x", 'name: "\\ud800"'),
    "unknown kind": MINIMAL.replace("sinusoid", "sinusiod"),
    "no kind": MINIMAL.replace("kind: dnn_mso", "inversion: {}"),
    "kind of a wrong type": MINIMAL.replace("sinusoid", "[1]"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_one_fault_is_one_line_that_says_what_and_where(case: str) -> None:
    extra, expected = REFUSED[case]
    message = refusal(INSTEAD.get(case, MINIMAL) + extra)
    assert message.startswith(f"s.yaml:{expected}")
    assert "\n" not in message
    assert message.isprintable()


def test_several_faults_are_all_told_in_the_order_of_their_lines() -> None:
    text = MINIMAL + (
        "foo: 1\nseed: 1\nplant:\n  gravity: -1\n  masses: [1, a, true]\nseed: 2\n"
        "duration: !!float 3\n"
    )
    assert refusal(text).splitlines() == [
        f"s.yaml:6: foo = 1: unknown key; allowed: {TOP}",
        "s.yaml:9: plant.gravity = -1: is out of range; allowed: a number >= 0",
        's.yaml:10: plant.masses.1 = "a": is text; allowed: a number > 0',
        "s.yaml:10: plant.masses.2 = true: is true or false; allowed: a number > 0",
        "s.yaml:11: seed: duplicate key, first given on line 7; allowed: once",
        "s.yaml:12: duration: the tag tag:yaml.org,2002:float; allowed: values without a tag",
    ]


def test_every_wrong_length_is_told() -> None:
    lines = refusal(MINIMAL + "initial:\n  q: [0, 0, 0]\n  qd: [1, 1]\n").splitlines()
    assert lines == [
        "s.yaml:1: plant.masses = [1.0, 2.3] (the default): has 2 entries; allowed: 3, since "
        "initial.q has 3 entries",
        "s.yaml:8: initial.qd = [1, 1]: has 2 entries; allowed: 1 or 3, since initial.q has 3 "
        "entries",
    ]


def test_a_missing_key_says_what_it_is_for() -> None:
    assert refusal("name: x\ncontroller: {kind: dnn_mso}\nreference:\n  kind: setpoint\n") == (
        "s.yaml:3: reference.start: missing key; allowed: a list of numbers (Joint angles before "
        "the move (rad))\n"
        "s.yaml:3: reference.goal: missing key; allowed: a list of numbers (Joint angles after "
        "the move (rad))\n"
        "s.yaml:3: reference.blend_time: missing key; allowed: a number > 0 (How long the move "
        "takes (s))"
    )


def test_waypoint_times_must_increase() -> None:
    text = (
        "name: x\ncontroller: {kind: dnn_mso}\nreference:\n  kind: waypoints\n"
        "  times:\n  - 0\n  - 2\n  - 2\n  points: [[0, 0], [1, 1], [0, 0]]\n"
    )
    assert refusal(text) == (
        "s.yaml:8: reference.times.2 = 2: is not after 2.0; allowed: strictly increasing times"
    )
    assert "reference.times = [0, 2]: has 2 entries; allowed: 3" in refusal(
        text.replace("  - 2\n  - 2\n", "  - 2\n")
    )


def test_motions_within_less_than_a_step_are_refused() -> None:
    text = (
        "name: x\ncontroller: {kind: dnn_mso}\nreference:\n  kind: waypoints\n"
        "  times: [0, 1e-300, 1]\n  points: [[0, 0], [1, 1], [0, 0]]\n"
    )
    assert refusal(text) == (
        "s.yaml:5: reference.times.1 = 1e-300: comes 1e-300 s after the time before, less than "
        "one step; allowed: dt = 0.001 or more"
    )
    simulate(load(text, "reference.times=[0, 0.001, 1]", "duration=0.05"))
    blend = "reference={kind: setpoint, start: [0, 0], goal: [1, 1], blend_time: 1e-300}"
    assert "reference.blend_time = 1e-300: is less than one step" in refusal(MINIMAL, blend)


def test_thousands_of_faults_are_cut_short() -> None:
    lines = refusal(MINIMAL + "".join(f"k{k}: 1\n" for k in range(3000))).splitlines()
    assert len(lines) == 101
    assert lines[-1] == "… and 2900 more"


# --- files that are no scenario

UNREADABLE = {
    "empty": (b"", f"1: the file is empty; allowed: the keys {TOP}"),
    "comments only": (b"# nothing\n", "1: the file is empty"),
    "blanks": (b"  ", "1: the file is empty"),
    "a list": (b"\n- 1\n", "2: the file holds a list"),
    "a word": (b"paper", "1: the file holds a single value"),
    "a NUL byte": (b"name: x\nseed: \0\n", "2: not valid YAML: the character U+0000"),
    "not UTF-8": (b"name: x\n# \xff\n", "2: byte 0xff; allowed: text in UTF-8"),
    "UTF-16": ("name: x\n".encode("utf-16"), "1: byte 0xff; allowed: text in UTF-8"),
    "two documents": (b"name: x\n---\nname: y\n", "2: a second document begins; allowed: one"),
    "YAML 1.1": (b"%YAML 1.1\n---\nname: x\n", "2: %YAML 1.1; allowed: YAML 1.2"),
    "an open bracket": (b"name: x\nplant: [1,\n", "3: not valid YAML: while parsing a flow"),
    "a tab": (b"\tname: x\n", "1: not valid YAML: while scanning"),
    "an escape past Unicode": (b'name: x\ndescription: "\\UFFFFFFFF"\n', "2: not valid YAML: an"),
    "a tag that constructs": (b"!!python/object/apply:os.system [id]\n", "1: the tag tag:yaml.org"),
    "an unknown alias": (b"name: *x\n", "1: *x stands for nothing; allowed: an earlier &x"),
    "an alias in itself": (b"name: &x [*x]\n", "1: *x stands for nothing"),
    "a list as a key": (b"? [a]\n: b\n", "1: a list, a mapping or an alias as a key"),
    "an alias as a key": (b"a: &x b\n*x : c\n", "2: a list, a mapping or an alias as a key"),
    "deep nesting": (b"name: x\nplant: " + b"[" * 100_000, "2: nested too deeply; allowed: 32"),
    "deep block nesting": (b"- " * 100_000, "1: nested too deeply"),
    "too many values": (b"a: [" + b"1," * 60_000 + b"]", "1: too many values; allowed: at most"),
    "a number without end": (b"seed: " + b"9" * 5000, "1: seed: a number of 5000 characters; "),
}


@pytest.mark.parametrize("case", UNREADABLE)
def test_a_file_that_is_no_scenario_is_refused(case: str) -> None:
    text, expected = UNREADABLE[case]
    started = time.perf_counter()
    assert refusal(text).startswith(f"s.yaml:{expected}")
    assert time.perf_counter() - started < 5.0


def test_a_bomb_of_aliases_is_counted_and_not_unfolded() -> None:
    layers = ["a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    for above, name in zip("abcdefgh", "bcdefghi", strict=True):
        layers.append(f"{name}: &{name} [{', '.join([f'*{above}'] * 10)}]")
    assert refusal("\n".join(layers)) == "s.yaml:4: too many values; allowed: at most 10000"


def test_a_file_too_large_is_refused_unread() -> None:
    message = refusal("#" * 300_000)
    assert message == "s.yaml: too large for a scenario; allowed: 262144 bytes"


def test_a_file_that_cannot_be_read_is_refused() -> None:
    # Nothing is mapped at the address 0, so reading from there fails, for root as well.
    with pytest.raises(ScenarioError, match=r"^/proc/self/mem: cannot be read: "):
        load_scenario("/proc/self/mem")


def test_what_a_terminal_would_obey_is_escaped() -> None:
    message = refusal(f'{MINIMAL}"\\e[31m\\n\\u0085": "\\e[2J\\u202e"\n')
    assert message.isprintable()
    assert "\\x1b[31m\\n" in message


# --- overrides


@pytest.mark.parametrize(
    ("override", "read"),
    [
        ("plant.gravity=1e-3", lambda s: s.plant.gravity == 0.001),
        ("plant.gravity = 3 ", lambda s: s.plant.gravity == 3.0),
        ("plant.masses=[1, 2]", lambda s: s.plant.masses == (1.0, 2.0)),
        ("plant.masses.1=3", lambda s: s.plant.masses == (1.0, 3.0)),
        ("imperfections.torque_limit=200", lambda s: s.imperfections.torque_limit == (200.0,)),
        ("controller.network.init_scale=null", lambda s: s.controller.network.init_scale is None),
        ("controller.madam.bias_correction=true", lambda s: s.controller.madam.bias_correction),
        ("description='a=b: c'", lambda s: s.description == "a=b: c"),
        ("initial={q: [1, 2]}", lambda s: s.initial.q == (1.0, 2.0)),
    ],
)
@pytest.mark.parametrize("text", [PAPER, MINIMAL], ids=["spelled out", "by default"])
def test_an_override_sets_what_the_file_says_or_leaves_out(
    text: str, override: str, read: Callable[[Scenario], bool]
) -> None:
    assert read(load(text, override))


def test_the_last_of_two_overrides_wins() -> None:
    assert load(PAPER, "seed=1", "seed=2").seed == 2
    assert load(PAPER, "plant.masses.0=9", "plant.masses=[1, 2]").plant.masses == (1.0, 2.0)
    assert "--set seed=-2: " in refusal(PAPER, "seed=-1", "seed=-2")


REFUSED_OVERRIDES = {
    "a.b": "no '='; allowed: KEY.PATH=VALUE, as in plant.gravity=1.62",
    "": "no '='; allowed: KEY.PATH=VALUE",
    "=3": "an empty key; allowed: KEY.PATH=VALUE",
    "a..b=1": "an empty key; allowed: ",
    ".a=1": "an empty key; allowed: ",
    "a.=1": "an empty key; allowed: ",
    "plant.gravity=": "no value; allowed: KEY.PATH=VALUE, as in plant.gravity=1.62; null for ",
    "plant.gravity=[1": "not valid YAML: while parsing a flow sequence",
    "plant.gravity=!!int 3": "the tag tag:yaml.org,2002:int; allowed: values without a tag",
    "plant.gravity=-1": "plant.gravity = -1: is out of range; allowed: a number >= 0",
    "plant.gravity=.nan": "plant.gravity = .nan: is not finite; allowed: a number >= 0",
    "plant.gravity=no": 'plant.gravity = "no": is text; allowed: a number >= 0',
    "plant.gravty=3": "plant.gravty = 3: unknown key; allowed: model, links, masses, lengths, "
    "gravity, integrator; did you mean 'gravity'?",
    "plnt.gravity=3": "plnt = {gravity: 3}: unknown key; allowed: name, ",
    "plant.gravity.x=3": "plant.gravity = 9.81: has no entry x; allowed: a whole new value",
    "plant.masses.2=3": "plant.masses = [1.0, 2.3]: has no entry 2; allowed: entries 0 to 1",
    "plant.masses.-1=3": "plant.masses = [1.0, 2.3]: has no entry -1; allowed: entries 0 to 1",
    "plant.masses.1=x": 'plant.masses.1 = "x": is text; allowed: a number > 0',
    "plant.masses=[1]": "",
    "imperfections.torque_limit.0=3": "imperfections.torque_limit = null: has no entry 0",
    "plant={gravity: -1}": "plant.gravity = -1: is out of range; allowed: a number >= 0",
    "plant.model=mine.xml": 'plant.model = "mine.xml": no model "mine.xml" in ',
    "controller.kind=nonetwork": 'controller.kind = "nonetwork": is none of the choices; allowed: '
    f"one of: {KINDS}; did you mean 'no_network'?",
    "duration=1.0005": "duration = 1.0005: is 1000.5 steps of dt = 0.001; allowed: ",
}


@pytest.mark.parametrize("text", [PAPER, MINIMAL], ids=["spelled out", "by default"])
@pytest.mark.parametrize("override", [o for o, e in REFUSED_OVERRIDES.items() if e])
def test_a_wrong_override_is_refused_in_its_own_name(text: str, override: str) -> None:
    message = refusal(text, override)
    assert message.startswith(f"--set {override}: {REFUSED_OVERRIDES[override]}")
    assert "\n" not in message


def test_every_malformed_override_is_told() -> None:
    assert refusal(PAPER, "a", "seed=1", "=b").splitlines() == [
        "--set a: no '='; allowed: KEY.PATH=VALUE, as in plant.gravity=1.62",
        "--set =b: an empty key; allowed: KEY.PATH=VALUE, as in plant.gravity=1.62",
    ]


def test_faults_of_the_file_come_before_those_of_overrides() -> None:
    message = refusal(MINIMAL + "plant:\n  gravity: -1\n", "seed=-1", "duration=0")
    places = [line.split(": ")[0] for line in message.splitlines()]
    assert places == ["s.yaml:7", "--set seed=-1", "--set duration=0"]


def test_an_override_mends_a_fault_of_the_file() -> None:
    assert load(MINIMAL + "plant:\n  gravity: -1\n", "plant.gravity=1").plant.gravity == 1.0


def test_a_changed_kind_drops_what_belonged_to_the_old_one() -> None:
    off = load(PAPER, "controller.kind=no_network")
    assert isinstance(off.controller, NoNetwork)
    assert off.controller.inversion.K == (7.5,)
    blend = [f"reference.{x}" for x in ("start=[0, 0]", "goal=[1, 1]", "blend_time=2")]
    for order in ([*blend, "reference.kind=setpoint"], ["reference.kind=setpoint", *blend]):
        assert isinstance(load(PAPER, *order).reference, Setpoint)
    constant = "controller.inversion.effectiveness.kind=constant"
    for text in (PAPER, MINIMAL):
        assert load(text, constant).controller.inversion.effectiveness.kind == "constant"


def test_a_changed_kind_asks_for_what_the_new_one_needs() -> None:
    lines = refusal(PAPER, "reference.kind=setpoint").splitlines()
    assert [line.split(";")[0] for line in lines] == [
        f"--set reference.kind=setpoint: reference.{key}: missing key"
        for key in ("start", "goal", "blend_time")
    ]


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        (
            "controller.madam.eta=0.1",
            "controller.madam.eta = 0.1: controller.kind = no_network has no madam; allowed: "
            "kind, inversion, observer, kinematics",
        ),
        (
            "controller.madam={eta: 0.1}",
            "controller.madam = {eta: 0.1}: unknown key; allowed: kind, inversion, observer, "
            "kinematics",
        ),
    ],
)
def test_a_set_key_that_the_new_kind_does_not_have_is_refused(override: str, expected: str) -> None:
    kind = "controller.kind=no_network"
    for order in ([override, kind], [kind, override]):
        assert refusal(PAPER, *order) == f"--set {override}: {expected}"


def test_a_kind_that_does_not_change_drops_nothing() -> None:
    text = MINIMAL.replace("dnn_mso", "no_network\n  madam: {}")
    expected = "s.yaml:6: controller.madam = {}: unknown key"
    assert refusal(text, "controller.kind=no_network").startswith(expected)


def test_a_whole_part_can_be_replaced() -> None:
    scenario = load(PAPER, "reference={kind: sinusoid, amplitude: [1, 2]}")
    assert isinstance(scenario.reference, Sinusoid)
    assert scenario.reference.phase == (0.0,)


# --- the warning


def messages(*overrides: str, text: str = PAPER) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load(text, *overrides)
    assert all(item.category is ScenarioWarning for item in caught)
    return [str(item.message) for item in caught]


def test_a_torque_limit_under_the_static_gravity_load_warns() -> None:
    limit = "imperfections.torque_limit=[54, 23]"
    assert messages(limit) == [
        f"--set {limit}: imperfections.torque_limit = [54, 23]: joint 1 is limited to 54 N·m, "
        "under the static gravity load of 54.94 N·m of the arm stretched out level; no controller "
        "can hold it"
    ]
    assert len(messages("imperfections.torque_limit=20")) == 2
    assert messages("imperfections.torque_limit=54.94") == []
    assert messages("imperfections.torque_limit=54.93") != []


def test_the_warning_names_the_line_of_the_limit() -> None:
    (message,) = messages(text=MINIMAL + "imperfections:\n  torque_limit: [40, 23]\n")
    assert message.startswith("s.yaml:7: imperfections.torque_limit = [40, 23]: joint 1 ")


def test_nothing_is_said_where_the_limit_suffices_or_the_masses_are_unknown() -> None:
    assert messages("imperfections.torque_limit=[55, 23]") == []
    assert messages("plant.gravity=0", "imperfections.torque_limit=1") == []
    unknown = ("plant.masses=null", "plant.lengths=null", "imperfections.torque_limit=1")
    assert messages(*unknown) == []


GAINS = [
    (("lam=1990",), ""),
    (("lam=1993",), "lam = 1993: makes the loop, sampled each dt, unstable even with an exact "),
    (("K=1990",), ""),
    (("K=1993",), "stable: K + lam < 2/dt = 2000"),
    (("K=[3900, 3900, 7.5, 7.5]",), ""),
    (("K=[4100, 4100, 7.5, 7.5]",), "stable: lam K dt < 2 (K + lam)"),
    (("lam=1993", "effectiveness.kind=constant"), ""),  # b may make up for it
]


@pytest.mark.parametrize(("gains", "told"), GAINS)
def test_gains_that_no_step_of_dt_can_hold_are_warned_of(gains: tuple[str], told: str) -> None:
    found = messages(*(f"controller.inversion.{gain}" for gain in gains))
    assert [told in message for message in found] == ([True] if told else [])


@pytest.mark.parametrize(("lam", "stable"), [(1990, True), (1996, False)])
def test_the_warning_of_gains_is_right(lam: int, stable: bool) -> None:
    """K + λ = 1997.5 and 2003.5 with dt = 1 ms, without a network: just stable, just not."""
    text = (scenarios_dir() / "paper_no_network.yaml").read_text()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trace = simulate(load(text, f"controller.inversion.lam={lam}", "duration=2"))
    assert (trace.info.status == "ok") == stable


@pytest.mark.parametrize("links", ["point_mass", "rod"])
def test_the_static_load_is_the_gravity_torque_at_full_stretch(links: str) -> None:
    rng = np.random.default_rng(7)
    for _ in range(20):
        masses, lengths = rng.uniform(0.1, 5.0, (2, 2)).tolist()
        plant = Plant(masses=masses, lengths=lengths, links=links)  # type: ignore[arg-type]
        arm = TwoLink(tuple(masses), tuple(lengths), 9.81, links)  # type: ignore[arg-type]
        np.testing.assert_allclose(stretched_load(plant), arm.gravity_torque(np.zeros(2)))
        q = rng.uniform(-np.pi, np.pi, (1000, 2))
        assert np.all(np.abs(arm.gravity_torque(q)) <= stretched_load(plant) + 1e-12)


def test_the_static_load_of_three_links() -> None:
    plant = Plant(masses=[1, 2, 3], lengths=[0.5, 0.4, 0.3], gravity=10.0)  # type: ignore[arg-type]
    by_hand = [10 * (0.5 + 2 * 0.9 + 3 * 1.2), 10 * (2 * 0.4 + 3 * 0.7), 10 * 3 * 0.3]
    np.testing.assert_allclose(stretched_load(plant), by_hand)


# --- whatever the file holds, it loads or is refused

LINES = PAPER.splitlines()
KEYS = sorted({line.split(":")[0].strip() for line in LINES if ":" in line and line[0] != "#"})
VALUES = ["", "1", "-1", "1e999", ".nan", "null", "true", "x", "[]", "{}", "[[1]]", "{kind: x}"]
VALUES += ["&a 1", "*a", "!!int 3", "!t", "|", "'", '"\\ud800"', "? ", "- 1", "[1, 2, 3]", "\t"]


@st.composite
def mutated(draw: st.DrawFn) -> bytes:
    """paper.yaml after up to five accidents."""
    lines = list(LINES)
    for _ in range(draw(st.integers(0, 4))):
        k = draw(st.integers(0, len(lines) - 1))
        key, _, value = lines[k].partition(":")
        indent = key[: len(key) - len(key.lstrip())]
        other = draw(st.sampled_from(KEYS) | st.text(max_size=5))
        new = draw(st.sampled_from(VALUES) | st.text(max_size=8) | st.floats().map(repr))
        renamed, swapped, moved = f"{indent}{other}:{value}", f"{key}: {new}", f" {lines[k]}"
        lines[k : k + 1] = draw(
            st.sampled_from([[renamed], [swapped], [moved], [], [lines[k], swapped]])
        )
        lines = lines or [""]
    raw = bytearray("\n".join(lines).encode("utf-8", "surrogatepass"))
    flips = st.tuples(st.integers(0, 9999), st.integers(0, 255))
    for place, byte in draw(st.lists(flips, max_size=2)):
        if raw:
            raw[place % len(raw)] = byte
    return bytes(raw)


def attempt(source: str | Path, sets: Sequence[str] = ()) -> tuple[Scenario | None, list[str]]:
    """The scenario, or the lines of its refusal; any other exception goes through."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ScenarioWarning)
            return load_scenario(source, sets), []
    except ScenarioError as error:
        return None, str(error).split("\n")


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("scratch") / "s.yaml"


@settings(
    max_examples=400,
    deadline=1000,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(mutated())
def test_any_mutation_of_a_scenario_loads_or_is_refused(scratch: Path, raw: bytes) -> None:
    scratch.write_bytes(raw)
    scenario, lines = attempt(scratch)
    assert all(line.isprintable() for line in lines)
    if scenario is not None:
        assert Scenario.model_validate_json(scenario.model_dump_json()) == scenario


@settings(
    max_examples=200,
    deadline=1000,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    st.lists(
        st.lists(st.sampled_from(KEYS) | st.integers(-1, 3).map(str), min_size=1, max_size=4),
        max_size=3,
    ),
    st.lists(st.sampled_from(VALUES) | st.sampled_from(["no_network", "setpoint"]), min_size=3),
)
def test_any_override_is_taken_or_refused(paths: list[list[str]], values: list[str]) -> None:
    sets = [f"{'.'.join(p)}={v}" for p, v in zip(paths, values, strict=False)]
    _, lines = attempt("paper", sets)
    assert all(line.startswith(("--set ", str(scenarios_dir()))) for line in lines)


def every_place() -> Iterator[tuple[dict[str, Any], dict[str, Any], str]]:
    """Each key that a scenario can have: a draft, the part of it that has the key, and the key."""

    def within(
        shape: Shape, path: tuple[str | int, ...], kinds: dict[tuple[str | int, ...], str]
    ) -> Iterator[tuple[tuple[str | int, ...], dict[tuple[str | int, ...], str]]]:
        for kind, alternative in shape.kinds.items():
            yield from within(alternative, path, {**kinds, path: kind})
        for key in shape.keys if not shape.kinds else ():
            yield (*path, key), kinds
            below = shape.child(key)
            yield from within(below, (*path, key), kinds) if below else ()
        entry = shape.child(0) if not shape.kinds else None
        if entry and (entry.kinds or entry.keys):
            yield from within(entry, (*path, 0), kinds)

    for path, kinds in within(Shape.root(), (), {}):
        draft: dict[str, Any] = {
            "name": "x",
            "reference": {"kind": "sinusoid"},
            "controller": {"kind": "dnn_mso"},
        }
        part: Any = draft
        for k, key in enumerate(path):
            if path[:k] in kinds:
                part["kind"] = kinds[path[:k]]
            if k == len(path) - 1:
                yield draft, part, key
            elif path[k + 1] == 0:
                part = part.setdefault(key, [{}])
            else:
                part = part[0] if key == 0 else part.setdefault(key, {})


@pytest.mark.parametrize("value", [None, 5, {"kind": 5}, [None]], ids=str)
def test_whatever_stands_at_any_key_is_taken_or_refused(scratch: Path, value: Any) -> None:
    count = 0
    for draft, part, key in every_place():
        part[key] = value
        scratch.write_text(json.dumps(draft))
        attempt(scratch)
        count += 1
    assert count > 200
