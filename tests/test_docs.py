"""README and docs: their commands run, their links lead somewhere, their Python works."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from vulkan import needs_vulkan

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
BIN = Path(sys.executable).parent


def blocks(page: Path, language: str) -> list[str]:
    pattern = rf"^```{language}\n(.*?)^```"
    return re.findall(pattern, page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def commands(page: Path, program: str) -> list[list[str]]:
    lines = [line for block in blocks(page, "sh") for line in block.splitlines()]
    split = [shlex.split(line, comments=True) for line in lines]
    return [words for words in split if words and words[0] == program]


@pytest.fixture(scope="module")
def workplace(tmp_path_factory) -> Path:
    """A folder with the logs that the pages speak of, and the files that they have one write."""
    folder = tmp_path_factory.mktemp("workplace")
    titled = re.compile(
        r'^```(?:yaml|python) title="([\w.]+)"\n(.*?)^```', re.MULTILINE | re.DOTALL
    )
    for page in PAGES:
        for name, content in titled.findall(page.read_text(encoding="utf-8")):
            (folder / name).write_text(content, encoding="utf-8")
    for name in ("paper", "paper_no_network"):
        short = [BIN / "dnnmso", "run", name, "--set", "duration=0.2", "--no-plot"]
        subprocess.run(short, cwd=folder, check=True, capture_output=True, timeout=120)
    return folder


def run(words: list[str], workplace: Path) -> None:
    if "--at" in words:
        words[words.index("--at") + 1] = "0.1"  # the logs here are short
    command = [BIN / words[0], *words[1:]]
    done = subprocess.run(
        command, cwd=workplace, capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, (words, done.stderr)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_dnnmso_command_on_the_page_runs(page, workplace):
    for words in commands(page, "dnnmso"):
        waits = "--serve" in words or words[1:] == ["replay", "logs/paper.mcap"]
        # What waits for a person, and what draws, is tried in test_viewer.py and below.
        if not waits and "--screenshot" not in words:
            run(words, workplace)


@needs_vulkan
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_screenshot_on_the_page_can_be_taken(page, workplace):
    for words in commands(page, "dnnmso"):
        if "--screenshot" in words:
            run(words, workplace)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_make_target_on_the_page_exists(page):
    for words in commands(page, "make"):
        dry = ["make", "--dry-run", *words[1:]]
        done = subprocess.run(dry, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, (words, done.stderr)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_python_block_on_the_page_runs(page, workplace):
    for block in blocks(page, "python"):
        subprocess.run([sys.executable, "-c", block], cwd=workplace, check=True, timeout=120)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_on_the_page_leads_to_a_file(page):
    for target in re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (page.parent / target).exists(), target


def test_the_readme_does_have_commands_and_pictures():
    assert len(commands(ROOT / "README.md", "dnnmso")) > 4
    assert len(commands(ROOT / "README.md", "make")) == 2
    assert (ROOT / "README.md").read_text(encoding="utf-8").count("![") > 4
