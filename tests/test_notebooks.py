"""Notebooks: each runs from its first cell to its last, in a folder of its own."""

from __future__ import annotations

import base64
import io
import os
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient
from PIL import Image

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
NAMES = [path.stem for path in NOTEBOOKS]
EACH = pytest.mark.parametrize("name", NAMES)


def execute(path: Path, folder: Path) -> nbformat.NotebookNode:
    """The notebook with its outputs; a cell that raises fails."""
    notebook = nbformat.read(path, as_version=4)
    folder.mkdir()
    NotebookClient(notebook, timeout=120, resources={"metadata": {"path": folder}}).execute()
    keep = os.environ.get("DNNMSO_NOTEBOOKS")  # a folder, to look at what they show
    if keep:
        nbformat.write(notebook, Path(keep) / path.name)
    return notebook


@pytest.fixture(scope="module")
def executed(tmp_path_factory) -> dict[str, nbformat.NotebookNode]:
    """All of them, two at a time: a kernel waits a good deal while it starts."""
    folder = tmp_path_factory.mktemp("notebooks")
    with ThreadPoolExecutor(2) as pool:
        done = [pool.submit(execute, path, folder / path.stem) for path in NOTEBOOKS]
        return {path.stem: one.result() for path, one in zip(NOTEBOOKS, done, strict=True)}


def outputs(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    return [out for cell in notebook.cells for out in cell.get("outputs", [])]


def text(notebook: nbformat.NotebookNode) -> str:
    return "".join(out.text for out in outputs(notebook) if out.output_type == "stream")


def test_there_is_one_for_each_thing_a_newcomer_does():
    assert NAMES == ["adding_a_controller", "first_steps", "reading_a_log", "small_study"]


@EACH
def test_it_is_valid_and_kept_without_outputs(name):
    notebook = nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4)
    nbformat.validate(notebook)
    assert not outputs(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.execution_count is None for cell in code)
    assert len({cell.id for cell in notebook.cells}) == len(notebook.cells)


@EACH
def test_its_links_lead_to_files(name):
    source = (ROOT / "notebooks" / f"{name}.ipynb").read_text()
    for target in re.findall(r"\]\(([^)#\s]+)", source):
        assert (ROOT / "notebooks" / target).exists(), target


@EACH
def test_every_picture_it_shows_has_something_on_it(name, executed):
    shown = [out.get("data", {}) for out in outputs(executed[name])]
    pictures = [data["image/png"] for data in shown if "image/png" in data]
    assert pictures
    for picture in pictures:
        image = np.asarray(Image.open(io.BytesIO(base64.b64decode(picture))).convert("L"))
        assert (image < 200).mean() > 0.003
        assert image.shape[1] > 600


def test_first_steps_find_what_the_prose_says(executed):
    said = text(executed["first_steps"])
    on, off = (
        [float(number) for number in re.findall(r"[\d.]+(?= rad|(?= N))", line)]
        for line in re.findall(r"^network o.*$", said, re.MULTILINE)
    )
    assert on[0] < off[0]  # smaller error,
    assert on[1] > off[1]  # rougher torque
    assert "plant.gravity" in said
    assert "allowed: " in said


def test_each_step_of_the_controller_helps_and_what_cannot_be_kept_is_refused(executed):
    said = text(executed["adding_a_controller"])
    errors = [float(value) for value in re.findall(r"rmse_steady ([\d.]+)", said)]
    assert errors == sorted(errors, reverse=True)
    assert len(errors) == 3
    assert "attribute past of deque" in said


def test_the_log_tells_of_the_payload_and_of_snapshots(executed):
    said = text(executed["reading_a_log"])
    assert "1 kg taken up at the tip" in said
    assert re.findall(r"^ +(\d) s  \d+ weights", said, re.MULTILINE) == list("0123")
    assert "f_hat4   rad/s²" in said


def test_the_study_reports_intervals_and_pairs(executed):
    said = text(executed["small_study"])
    assert "20 runs of 3000 ticks" in said
    assert said.count("10 runs, 0 failed") == 2
    assert re.search(r"dnn_mso_tuned / pid_tuned: [\d.e-]+ \[[\d.e-]+, [\d.e-]+\], better at", said)
