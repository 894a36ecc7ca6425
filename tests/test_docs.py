"""README and docs: their commands run, their links lead somewhere, their Python works.

Commands run in this process, each once, in the order of the pages, in one folder with the logs and
files that the pages speak of; simulations take coarser steps. test_cli.py calls the program itself.
"""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dnnmso_mj.cli import app
from tests.vulkan import needs_vulkan

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
TEXTS = {str(page.relative_to(ROOT)): page.read_text(encoding="utf-8") for page in PAGES}

COARSER, COARSE = ["--set", "dt=0.005"], ["--set", "dt=0.002"]
BY_THE_CLOCK = ["--set", "duration=1.2"]
WRITES_A_TABLE = {"sweep", "compare", "margins", "tune"}


def cheaper(name: str, words: list[str]) -> list[str]:
    """Options that make a command cheap without making it another one.

    Fewer ticks and trials, one worker, and no figures, which test_plots.py draws.
    """
    if name == "run":
        return [*(BY_THE_CLOCK if "--real-time" in words else COARSE), "--no-plot"]
    if name == "check":
        return ["--states", "100"]
    if name == "audit":
        return [*COARSER, "--jobs", "1"]
    if name not in WRITES_A_TABLE:
        return []
    trials = ["--trials", "3"] if name == "tune" else []
    again = [] if "--resume" in words else ["--force"]  # pages may share a table's name
    return [*COARSER, "--jobs", "1", *trials, *again]


def blocks(text: str, language: str) -> list[str]:
    """The fenced blocks of a language, without those that are a file's content."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def files(text: str) -> dict[str, str]:
    """The files that a page has one write, by the titles of its blocks."""
    titled = r'^```\w+ title="([\w.]+)"\n(.*?)^```'
    return dict(re.findall(titled, text, re.MULTILINE | re.DOTALL))


def commands(program: str, text: str) -> list[str]:
    lines = [line for block in blocks(text, "sh") for line in block.splitlines()]
    split = [shlex.split(line, comments=True) for line in lines]
    return [shlex.join(words) for words in split if words and words[0] == program]


def all_commands(program: str) -> list[str]:
    """Each command of all pages once, in their order."""
    return list(dict.fromkeys(line for text in TEXTS.values() for line in commands(program, text)))


def is_tried_elsewhere(command: str) -> bool:
    """Whether it waits for a person (see test_viewer.py), or is what test_bench.py does anyway."""
    words = shlex.split(command)
    opens = words[1] == "replay" and not {"--save", "--screenshot"} & set(words)
    return opens or words[1] == "bench" or bool({"--serve", "--view"} & set(words))


def draws(command: str) -> bool:
    return "--screenshot" in command


@pytest.fixture(scope="module")
def workplace(tmp_path_factory) -> Path:
    """A folder with the logs that the pages speak of, and the files that they have one write."""
    folder = tmp_path_factory.mktemp("workplace")
    for text in TEXTS.values():
        for name, content in files(text).items():
            (folder / name).write_text(content, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for name in ("paper", "paper_no_network"):
            CliRunner().invoke(app, ["run", name, "--no-plot"], catch_exceptions=False)
    return folder


def invoke(command: str) -> None:
    """Run a command as it stands, but for what makes it cheaper."""
    name, *words = shlex.split(command)[1:]
    words = [*words, *cheaper(name, words)]
    done = CliRunner().invoke(app, [name, *words], catch_exceptions=False)
    answers = {0, 1} if name == "diff" else {0}  # 1: the logs differ
    assert done.exit_code in answers, (command, done.output)


@pytest.mark.parametrize(
    "command", [c for c in all_commands("dnnmso") if not is_tried_elsewhere(c) | draws(c)]
)
def test_the_command_runs(command, workplace, monkeypatch):
    monkeypatch.chdir(workplace)
    invoke(command)


@needs_vulkan
@pytest.mark.parametrize("command", [c for c in all_commands("dnnmso") if draws(c)])
def test_the_screenshot_can_be_taken(command, workplace, monkeypatch):
    monkeypatch.chdir(workplace)
    invoke(command)


@pytest.mark.parametrize("command", all_commands("make"))
def test_the_make_target_exists(command):
    dry = ["make", "--dry-run", *shlex.split(command)[1:]]
    done = subprocess.run(dry, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", [name for name in TEXTS if blocks(TEXTS[name], "python")])
def test_the_pages_python_runs(page, workplace, monkeypatch):
    """All blocks of a page, one after the other."""
    monkeypatch.chdir(workplace)
    monkeypatch.syspath_prepend(workplace)  # as for a script that stands there
    names: dict[str, object] = {"__name__": "__page__"}
    for block in blocks(TEXTS[page], "python"):
        exec(compile(block, page, "exec"), names)


@pytest.mark.parametrize("page", TEXTS)
def test_every_link_on_the_page_leads_to_a_file(page):
    for target in re.findall(r"\]\(([^)#\s]+)", TEXTS[page]):
        if "://" not in target:
            assert (ROOT / page).parent.joinpath(target).exists(), target


def test_every_test_that_a_page_names_exists():
    code = "".join(file.read_text(encoding="utf-8") for file in (ROOT / "tests").glob("test_*.py"))
    for page, text in TEXTS.items():
        for name in re.findall(r"`(test_\w+)`", text):
            assert f"def {name}(" in code, (page, name)


def test_the_readme_does_have_commands_and_pictures():
    readme = TEXTS["README.md"]
    assert len(commands("dnnmso", readme)) > 4
    assert len(commands("make", readme)) == 2
    assert readme.count("![") > 4
