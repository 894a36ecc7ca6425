"""Row 8: files that mean harm are refused by name, in time and memory, and nothing else is opened.

Each is tried in a fork of its own (`watched`), beside a folder of canaries; a sample on the real
command line. What the command line itself names is read, which also shows that the watch notices.
"""

from __future__ import annotations

import json
import os
import random
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from dnnmso_mj.assets import put_back
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.loading.changing import change_scenario
from dnnmso_mj.paths import find_model, models_dir
from dnnmso_mj.plant import Mjcf, build_spec, compile_spec
from dnnmso_mj.policies import LoadedPolicy
from dnnmso_mj.scenario import Policy
from soak import hostile_mjcf, hostile_yaml
from soak.ended import dnnmso
from soak.tally import Form, Tally
from soak.watched import Canaries, Outcome, watch

MOST_SECONDS = 1.0  # of the processor: others may have it for longer
MOST_BYTES = 256 * 1024 * 1024
MOST_LINES, MOST_CHARACTERS = 101, 2000
TUNED = "controller: {kind: pd}\n"
MARKER = "canary-marker"
KEYS = {  # what a message names, by the first word of a case
    "model": "plant.model",
    "from": "controller.from",
    "chain": "tuned.yaml",
    "policy": "controller.file",
    "tuned": "controller.file",
    "code": "controller.python",
    "reference": "reference.python",
    "settings": "controller.settings",
}


@dataclass
class Place:
    """Where it is tried: scenario and model `inside`, canaries `outside`, called from `here`."""

    folder: Path

    def __post_init__(self) -> None:
        self.inside, self.outside, self.here = (
            self.folder / name for name in ("inside", "outside", "here")
        )
        for folder in (self.inside, self.outside, self.here):
            folder.mkdir()
        arm = (models_dir() / "two_link.xml").read_bytes()
        contents = {"xml": arm, "stl": hostile_mjcf.STL, "yaml": TUNED.encode()}
        for ending in ("xml", "stl", "png", "yaml", "onnx", "pt", "py", "bin"):
            data = contents.get(ending, f"{MARKER} = 1\n".encode())
            (self.outside / f"secret.{ending}").write_bytes(data)
            (self.inside / f"link.{ending}").symlink_to(self.outside / f"secret.{ending}")
            (self.inside / f"folder.{ending}").mkdir()
            os.mkfifo(self.inside / f"pipe.{ending}")
            (self.inside / f"zero.{ending}").symlink_to("/dev/zero")
            (self.inside / f"loop.{ending}").symlink_to(f"loop.{ending}")
            (self.inside / f"none.{ending}").symlink_to(self.outside / "none")
        os.mkfifo(self.outside / "pipe")
        (self.inside / "links").symlink_to(self.outside)
        self.kept = set(self.inside.iterdir())
        self.canaries = Canaries(self.outside)

    def put(self, files: dict[str, bytes]) -> None:
        """Only these files, beside the links, in `inside`."""
        for path in set(self.inside.iterdir()) - self.kept:
            path.unlink()
        for name, data in files.items():
            (self.inside / name).write_bytes(data)

    def close(self) -> None:
        """Watch no more."""
        self.canaries.close()


def prepare(file: Path, sets: tuple[str, ...], here: Path, trust: bool = False) -> None:
    """All that is read before a run begins."""
    os.chdir(here)
    scenario = load_scenario(file, sets, trust=trust)
    mjcf = Mjcf.read(find_model(scenario.plant.model))
    compile_spec(build_spec(scenario.plant, scenario.dt, mjcf), scenario.plant.model)
    if isinstance(scenario.controller, Policy):
        LoadedPolicy(scenario.controller, 12, 2)


def judge(tally: Tally, what: str, outcome: Outcome, named: str) -> None:
    """Count something that had to be refused, naming `named`."""
    what = f"{what[:120]!r}: "
    if outcome.touched:
        tally.admit(f"{what}opened outside: {outcome.touched[:3]}")
    elif not outcome.error:
        tally.admit(f"{what}accepted")
    elif not outcome.ours:
        tally.lose(f"{what}{outcome.error}: {outcome.text}")
    elif "MuJoCo says" in outcome.text:
        tally.admit(f"{what}reached MuJoCo: {outcome.text[:200]}")
    elif outcome.seconds > MOST_SECONDS or outcome.grown > MOST_BYTES:
        tally.lose(f"{what}{outcome.seconds:.2f} s, {outcome.grown >> 20} MB")
    elif problem := _unreadable(outcome.text, named):
        tally.lose(f"{what}{problem}: {outcome.text[:200]!r}")
    else:
        tally.survive()


def _unreadable(text: str, named: str) -> str:
    lines = text.split("\n")
    if MARKER in text:
        return "tells what stands in another file"
    if named not in text:
        return f"does not name {named}"
    if len(lines) > MOST_LINES or any(len(line) > MOST_CHARACTERS for line in lines):
        return "is too long"
    if not all(line.isprintable() for line in lines):
        return "holds control characters"
    if not any(word in text for word in ("allowed", "not valid YAML", "not XML", "--trust")):
        return "does not say what is allowed"
    return ""


def run(form: Form, tally: Tally, folder: Path) -> None:
    """Everything, each in a fork, then a sample on the command line."""
    rng = random.Random(form.seed)
    place = Place(folder)
    share = form.pick(0.35, 1.0)  # of all cases; another seed takes others
    seconds, grown = [0.0], [0]

    def attempt(what: str, action: Callable[[], object], named: str) -> None:
        if rng.random() < share:
            outcome = watch(action, place.canaries)
            seconds.append(outcome.seconds)
            grown.append(outcome.grown)
            judge(tally, what, outcome, named)

    count = form.pick(1, 12)
    try:
        _scenarios(rng, count, place, attempt)
        _models(rng, count, place, attempt)
        _reach(place, attempt)
        _logs(rng, form.pick(8, 60), place, attempt)
        _let_in(place, tally)
        _on_the_command_line(rng, form.pick(2, 20), place, tally)
        if not place.canaries.unchanged() or any(place.here.iterdir()):
            tally.admit("a file was written outside")
        else:
            tally.survive()
    finally:
        place.close()
    tally.figure("longest (CPU s)", round(max(seconds), 3))
    tally.figure("most memory (MB)", round(max(grown) / 2**20, 1))


Attempt = Callable[[str, Callable[[], object], str], None]


def _scenarios(rng: random.Random, count: int, place: Place, attempt: Attempt) -> None:
    file = place.inside / "mine.yaml"
    for what, data in hostile_yaml.files(rng, count):
        place.put({file.name: data})
        attempt(f"file: {what}", lambda: prepare(file, (), place.here), "mine.yaml")
    place.put({file.name: hostile_yaml.GOOD.encode()})
    for what, text in hostile_yaml.sets(rng, count):
        attempt(what, lambda text=text: prepare(file, (text,), place.here), "--set")
    for name in ("pipe", "folder", "zero", "loop", "none"):
        odd = place.inside / f"{name}.yaml"
        attempt(f"scenario {name}", lambda odd=odd: prepare(odd, (), place.here), odd.name)


def _models(rng: random.Random, count: int, place: Place, attempt: Attempt) -> None:
    scenario = (hostile_yaml.GOOD + "plant: {model: arm.xml}\n").encode()
    file = place.inside / "mine.yaml"
    for what, files in hostile_mjcf.models(rng, count, str(place.folder)):
        place.put({file.name: scenario, **files})
        attempt(f"model: {what}", lambda: prepare(file, (), place.here), "plant.model")


def _reach(place: Place, attempt: Attempt) -> None:
    file = place.inside / "mine.yaml"
    for what, files in _reaching(place):
        place.put(files)
        attempt(what, lambda: prepare(file, (), place.here), KEYS[what.split()[0]])
        tuned = place.inside / "tuned.yaml"
        if tuned.exists():
            sets = (f"controller.from={json.dumps(str(tuned))}",)
            place.put({**files, file.name: hostile_yaml.GOOD.encode()})
            attempt(f"{what}, set", lambda sets=sets: prepare(file, sets, place.here), "controller")
            place.put({})


def _reaching(place: Place) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Scenarios that name files which are none of theirs."""
    start = hostile_yaml.GOOD.replace("controller: {kind: pd}\n", "")
    for name in _outside_names(place):
        model = json.dumps(name.format("xml"))
        yield f"model {name}", _scenario(f"{hostile_yaml.GOOD}plant: {{model: {model}}}\n")
        chain = json.dumps(name.format("yaml"))
        yield f"from {name}", _scenario(f"{start}controller: {{from: {chain}}}\n")
        for ending in ("onnx", "pt"):
            policy = f"controller: {{kind: policy, file: {json.dumps(name.format(ending))}}}\n"
            yield f"policy {ending} {name}", _scenario(start + policy)
            grafted = _scenario(start + "controller: {from: tuned.yaml}\n")
            yield f"tuned {ending} {name}", {**grafted, "tuned.yaml": policy.encode()}
        code = json.dumps(name.format("py") + ":main")
        yield f"code {name}", _scenario(f"{start}controller: {{kind: external, python: {code}}}\n")
        bare = start.replace("{kind: sinusoid}", f"{{kind: external, python: {code}}}")
        yield f"reference {name}", _scenario(bare + "controller: {kind: pd}\n")
        if name not in _outside_names(place)[:8]:
            continue
        settings = f"settings: {{deep: [{{file: {json.dumps(name.format('bin'))}}}]}}"
        kind = "controller: {kind: external, python: an_entry_point, "
        yield f"settings {name}", _scenario(f"{start}{kind}{settings}}}\n")
    for module in ("os:system", "subprocess:run", "builtins:eval", "json:../../x", "pickle:loads"):
        kind = f"controller: {{kind: policy, python: '{module}'}}\n"
        yield f"code {module}", _scenario(start + kind)
    up = "../" * 12
    for package in ("json", "dnnmso_mj", "dnnmso_mj.cli", "numpy"):
        model = f"{package}:{up}{str(place.outside)[1:]}/secret.xml"
        yield f"model {package}", _scenario(f"{hostile_yaml.GOOD}plant: {{model: '{model}'}}\n")
    chain = "controller: {from: tuned.yaml}\n"
    yield "chain of files", {**_scenario(start + chain), "tuned.yaml": chain.encode()}


def _outside_names(place: Place) -> list[str]:
    names = ["../outside/secret.{}", f"{place.outside}/secret.{{}}", "links/secret.{}", "link.{}"]
    names += ["../inside/../outside/secret.{}", f"{place.outside}/pipe", "/dev/zero", "/etc/passwd"]
    names += ["pipe.{}", "folder.{}", "zero.{}", "loop.{}", "none.{}", "/proc/self/environ", "~/{}"]
    return [*names, "\0.{}", "x" * 5000 + ".{}", "../" * 500 + "etc/passwd", "file:///etc/{}", ""]


def _scenario(text: str) -> dict[str, bytes]:
    return {"mine.yaml": text.encode()}


def _logs(rng: random.Random, count: int, place: Place, attempt: Attempt) -> None:
    """What a log holds: a model with files, put in a folder, and a scenario to go on from."""
    models = list(_texts(hostile_mjcf.models(rng, 1, str(place.folder))))
    for what, text in rng.sample(models, min(count, len(models))):
        kept = {"asset/../outside/secret.stl": b"new", "asset/..": b"new", "asset/a/..": b"new"}
        attempt(f"log: {what}", lambda text=text, kept=kept: _put_back(text, kept), "plant.model")
    for name in ("..", "a/..", "x" * 300 + ".stl", "a&#10;b.stl"):
        text = hostile_mjcf.world(before=f'<asset><mesh file="{name}"/></asset>')
        kept = {f"asset/{name}": hostile_mjcf.STL}
        attempt(
            f"log's file {name}", lambda text=text, kept=kept: _put_back(text, kept), "plant.model"
        )
    base = load_scenario("paper")
    log = place.inside / "log.mcap"
    for controller in (
        {"kind": "policy", "file": str(place.outside / "secret.onnx")},
        {"kind": "policy", "file": str(place.inside / "law.pt")},
        {"kind": "policy", "python": f"{place.outside}/secret.py:main"},
        {"kind": "external", "python": "os:system", "settings": {"command": "touch ran"}},
    ):
        data: dict[str, Any] = {**base.model_dump(mode="json"), "controller": controller}
        scenario = type(base).model_validate(data)
        attempt(
            f"log's controller {controller}",
            lambda scenario=scenario: change_scenario(scenario, (), log),
            "log.mcap",
        )


def _texts(models: Iterable[tuple[str, dict[str, bytes]]]) -> Iterator[tuple[str, str]]:
    """Of models, those that a log can hold: it has text, and not bytes of another encoding."""
    for what, files in models:
        with suppress(UnicodeDecodeError):
            yield what, files["arm.xml"].decode()


def _put_back(text: str, kept: dict[str, bytes]) -> None:
    with TemporaryDirectory() as folder:
        put_back(text, kept, Path(folder))


def _let_in(place: Place, tally: Tally) -> None:
    """What the user names is read, wherever it is; and the watch notices."""
    file = place.inside / "mine.yaml"
    outside = json.dumps(str(place.outside / "secret.xml"))
    place.put({file.name: f"{hostile_yaml.GOOD}plant: {{model: {outside}}}\n".encode()})
    for what, sets, trust in (
        ("a model by --set", (f"plant.model={outside}",), False),
        ("a model with --trust", (), True),
    ):
        outcome = watch(lambda s=sets, t=trust: prepare(file, s, place.here, t), place.canaries)
        if outcome.error or not any("secret.xml" in name for name in outcome.touched):
            tally.lose(f"{what}: {outcome.error} {outcome.text}, touched {outcome.touched}")
        else:
            tally.survive()
    for name in ("../outside/secret.stl", str(place.outside / "new.stl")):
        text = hostile_mjcf.world(before=f'<asset><mesh name="m" file="{name}"/></asset>')
        kept = {f"asset/{name}": hostile_mjcf.STL}
        outcome = watch(partial(_put_back, text, kept), place.canaries)
        if outcome.error or outcome.touched:  # the log's own copy serves, in a folder of its own
            tally.lose(f"log's copy of {name}: {outcome}")
        else:
            tally.survive()


def _on_the_command_line(rng: random.Random, count: int, place: Place, tally: Tally) -> None:
    """Some of it again as a person meets it: one error, status 2, no traceback."""
    scenario = (hostile_yaml.GOOD + "plant: {model: arm.xml}\n").encode()
    models = list(hostile_mjcf.models(rng, 1, str(place.folder)))
    cases = [{"mine.yaml": data} for _, data in rng.sample([*hostile_yaml.files(rng, 1)], count)]
    cases += [{"mine.yaml": scenario, **files} for _, files in rng.sample(models, count)]
    cases += [files for _, files in rng.sample([*_reaching(place)], count)]
    file = place.inside / "mine.yaml"
    usual = dnnmso("run", "no-such-scenario", cwd=place.here).peak_bytes or 0
    for files in cases:
        place.put(files)
        place.canaries.touched()
        with tally.case(f"run of {str(files)[:150]}"):
            ended = dnnmso("run", file, "--no-plot", cwd=place.here)
            assert ended.is_one_error, (ended.status, ended.err[:300])
            assert (ended.peak_bytes or 0) - usual < MOST_BYTES, ended.peak_bytes
            assert not place.canaries.touched(), "opened outside"
            assert MARKER not in ended.err + ended.out
