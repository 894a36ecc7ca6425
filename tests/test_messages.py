"""What people can get wrong at the command line: each message names it, and says what to do.

Every line of the table is a command that is refused, with words that its message must have: the
culprit and its value, what is allowed or the next step. All end with status 2, without a traceback,
with nothing on standard output, and with the folder as it was.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import warnings
from pathlib import Path

import pytest

from dnnmso_mj import cli
from dnnmso_mj.extras import EXTRAS, extra_of

ROOT = Path(__file__).parents[1]
TUNE = "tune tuning --controller pd --trials 2 --seeds 0 --out"
REFUSALS = {
    # Commands and options.
    "rnu paper": ("rnu", "Did you mean 'run'?"),
    "fly": ("No such command 'fly'", "dnnmso --help"),
    "run": ("Missing argument", "dnnmso run --help"),
    "run paper --sed 1": ("--sed", "--seed"),
    "run paper extra": ("extra", "dnnmso run --help"),
    "run paper --seed one": ("--seed", "valid integer"),
    "sweep paper": ("Missing option '--seeds'", "dnnmso sweep --help"),
    "check --states 0": ("--states", "greater than or equal to 1"),
    "replay paper --serve --port 70000": ("--port", "65535"),
    "completion tcsh": ("tcsh", "bash", "zsh", "fish"),
    # Scenarios.
    "run papr": ("papr: no such file", "shipped scenarios: ", "did you mean 'paper'?"),
    "run mine.toml": ("mine.toml: no such file", "a YAML file"),
    "run .": (".: not a regular file", "allowed: a YAML file"),
    "run empty.yaml": ("empty.yaml:1: the file is empty", "allowed: the keys name, "),
    "run typo.yaml": ("typo.yaml:2: duraton = 3: unknown key", "did you mean 'duration'?"),
    "run torn.yaml": ("torn.yaml:2: not valid YAML",),
    "run logs/paper.mcap": ("logs/paper.mcap", "allowed: text in UTF-8"),
    # Values of keys.
    "run paper --set a": ("--set a: no '='", "KEY.PATH=VALUE, as in plant.gravity=1.62"),
    "run paper --set plant.gravty=1": ("plant.gravty", "did you mean 'gravity'?"),
    "run paper --set plant.gravity=-1": ("plant.gravity = -1", "allowed: a number >= 0"),
    "run paper --set seed=1.5": ("seed = 1.5", "allowed: a whole number"),
    "run paper --set duration=.nan": ("duration = .nan: is not finite", "allowed: a number > 0"),
    "run paper --set controller.kind=pdd": ("controller.kind = \"pdd\"", "did you mean 'pd'?"),
    "run paper --set controller.from=pid_tund": ("pid_tund", "did you mean 'pid_tuned'"),
    "run paper --set plant.model=nix": ("nix", "allowed: an MJCF file, or one of"),
    "run paper --set initial.q=[1]": ("initial.q has 1 entry", "allowed: "),
    "check --model nix": ("--model nix", "allowed: an MJCF file", "two_link"),
    # Logs.
    "info pusch": ("pusch: no such log", "newest first: push, paper", "did you mean 'push'?"),
    "info nowhere/run.mcap": ("nowhere/run.mcap: no such log", "allowed: a log file (.mcap)"),
    "info paper": ("logs/paper.mcap begins with", "expected an MCAP file", "`dnnmso run`"),
    "info push": ("logs/push.mcap is empty", "`dnnmso run`"),
    "info logs": ("logs is a directory", "allowed: an MCAP file"),
    "recover typo.yaml": ("typo.yaml begins with", "expected an MCAP file"),
    "plot nothing push": ("nothing: no such log", "newest first"),
    "replay nothing": ("nothing: no such log", "newest first"),
    "replay push --save x.txt": ("x.txt", "ends in .rrd"),
    "replay push --screenshot x.jpg": ("x.jpg", "ends in .png"),
    "report nothing": ("nothing: no such log", "newest first"),
    "report nothing.parquet": ("nothing.parquet: cannot be read", "dnnmso sweep"),
    # What is there is not written over; what cannot be written is said.
    "run paper_no_network --out typo.yaml": ("typo.yaml exists", "another name", "--force"),
    "run paper_no_network --out typo.yaml --force": ("typo.yaml is no log", "another name"),
    "run paper_no_network --out /proc/x.mcap": ("/proc/x.mcap cannot be written", "another place"),
    "new typo": ("typo.yaml: exists", "another NAME, another --out, or remove it first"),
    "new paper": ("NAME = paper: a scenario that ships", "my_paper"),
    "new a/b": ('NAME = "a/b": is not a name', "Letters, digits"),
    "new mine --from papr": ("papr: no such file", "did you mean 'paper'?"),
    "new mine --controller pidd": ('no controller "pidd"', "did you mean 'pid'?"),
    f"{TUNE} logs": ("logs: a folder", "allowed: a file, as in pid.yaml"),
    f"{TUNE} typo.yaml": ("typo.yaml: exists and is not a tuned controller", "another --out"),
    # Many runs.
    "sweep paper --seeds x": ("--seeds x", "allowed: START:STOP, a number, or a list"),
    "sweep paper --seeds 0 --engine rai": ('--engine "rai"', "allowed: local, ray"),
    "sweep paper --seeds 0 --grid plant.gravty=1": ("plant.gravty", "did you mean 'gravity'?"),
    "sweep paper --seeds 0 --out typo.yaml": ("typo.yaml", "allowed: "),
    "compare paper --controllers pd --seeds 0": ("--controllers pd: one", "two or more"),
    "compare paper --controllers pd,pdx --seeds 0": ('no controller "pdx"', "allowed: "),
    "margins paper --controllers pd --seeds 0 --rows delai": ("delai", "did you mean 'delay'?"),
    "audit paper --seeds 0 --at x": ("--at 'x'", "allowed: times in s, as in 10,25,50"),
    "bench stp": ('"stp": no such section', "did you mean 'step'?"),
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with a few files that are not what they are taken for."""
    folder = tmp_path_factory.mktemp("messages")
    (folder / "empty.yaml").write_text("")
    (folder / "typo.yaml").write_text("name: typo\nduraton: 3\n")
    (folder / "torn.yaml").write_text("name: [a\n")
    (folder / "logs").mkdir()
    (folder / "logs" / "paper.mcap").write_bytes(b"\xff not a log")
    (folder / "logs" / "push.mcap").write_bytes(b"")
    os.utime(folder / "logs" / "paper.mcap", (0, 0))
    return folder


def refused(command: str, monkeypatch: pytest.MonkeyPatch) -> int | str | None:
    """The status that the command ends with, run by the entry point itself."""
    monkeypatch.setattr(sys, "argv", ["dnnmso", *command.split()])
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    thresholds, handler = gc.get_threshold(), signal.getsignal(signal.SIGINT)
    try:
        with pytest.raises(SystemExit) as end, warnings.catch_warnings():
            cli.main()
    finally:
        gc.set_threshold(*thresholds)
        gc.unfreeze()
        signal.signal(signal.SIGINT, handler)
    return end.value.code


@pytest.mark.parametrize("command", REFUSALS)
def test_what_is_refused_is_told_with_what_to_do(command, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    before = contents(folder)
    assert refused(command, monkeypatch) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "Traceback" not in shown.err
    for words in REFUSALS[command]:
        assert words in shown.err
    usage = shown.err.startswith("Usage: ") and "\nError: " in shown.err and "--help" in shown.err
    assert usage or shown.err.startswith("error: ")
    assert contents(folder) == before


def contents(folder: Path) -> dict[Path, bytes | None]:
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def test_a_package_that_goes_missing_on_the_way_is_named_with_its_extra(monkeypatch, capsys):
    """Where a command did not ask beforehand."""

    def lacking() -> None:
        raise ModuleNotFoundError("No module named 'pyarrow.json'", name="pyarrow.json")

    monkeypatch.setattr("dnnmso_mj.loading.scenario_schema", lacking)
    assert refused("schema", monkeypatch) == 2
    assert capsys.readouterr().err == (
        "error: pyarrow.json is not installed: pip install 'dnnmso_mj[sweep]'\n"
    )
    assert {extra_of(m) for e in EXTRAS.values() for m in e.modules.values()} <= EXTRAS.keys()
    assert extra_of("numpy") is None
