"""Reports: one page that needs nothing else, says what ran, and takes nothing for markup."""

from __future__ import annotations

import base64
import io
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image
from sweep_samples import dnnmso

from dnnmso_mj.comparison.plan import plan_comparison
from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.margins.plan import plan_margins
from dnnmso_mj.margins.run import run_margins
from dnnmso_mj.report import ReportError, report_page, write_report
from dnnmso_mj.report.definitions import METRICS
from dnnmso_mj.report.page import Section, TableBlock, TextBlock, render
from dnnmso_mj.run import run_logged
from dnnmso_mj.sweep.local import LocalEngine
from dnnmso_mj.sweep.plan import plan_sweep
from dnnmso_mj.sweep.run import run_sweep
from dnnmso_mj.sweep.table import METADATA_KEY, METRIC_TYPES, read_table

VOID = {"meta", "img", "br", "hr", "link", "input"}
HOSTILE = "<script>alert('&')</script>"


class Page(HTMLParser):
    """A page taken apart: its elements, what they refer to, its text, its tables."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.references: list[str] = []
        self.ids: list[str] = []
        self.alts: list[str | None] = []
        self.words: list[str] = []
        self.feed(html)
        self.close()
        assert self.open == [], "elements that are never closed"

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        given = dict(attrs)
        self.references += [given[key] for key in ("src", "href", "action", "data") if key in given]
        self.ids += [given["id"]] if "id" in given else []
        self.alts += [given.get("alt")] if tag == "img" else []
        assert not [key for key in given if key.startswith("on")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    @property
    def pictures(self) -> list[Image.Image]:
        beginning = "data:image/png;base64,"
        found = [ref[len(beginning) :] for ref in self.references if ref.startswith(beginning)]
        return [Image.open(io.BytesIO(base64.b64decode(text))) for text in found]


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, Path]:
    """A file of each kind that a report takes, small."""
    folder = tmp_path_factory.mktemp("files")
    short = ["duration=0.1"]
    swept = plan_sweep(
        "paper",
        range(7),
        [*short, "controller.observer.K2=300"],
        ["controller.observer.feedback=stable,as_printed"],
    )
    run_sweep(swept, folder / "sweep.parquet", LocalEngine(1), command="dnnmso sweep paper …")
    compared = plan_comparison("paper", ["no_network", "dnn_mso"], range(7), short)
    run_sweep(compared, folder / "compare.parquet", LocalEngine(1))
    constant = ["controller.inversion.effectiveness={kind: constant}"]
    sought = plan_margins(
        "paper", ["no_network"], ["torque_limit", "model_above"], [0, 1], [*short, *constant], 0.5
    )
    run_margins(sought, folder / "margins.parquet", 1)
    scenario = load_scenario("paper", short)
    run_logged(scenario, folder / "run.mcap")
    return {file.stem: file for file in folder.iterdir()}


@pytest.fixture(scope="module")
def page(files) -> Page:
    names = ("sweep", "compare", "margins", "run")
    return Page(report_page([files[name] for name in names], "all.html"))


def test_nothing_is_fetched_and_nothing_runs(page):
    assert not {"script", "link", "iframe", "object", "form", "base"} & set(page.tags)
    outside = [
        ref for ref in page.references if not ref.startswith(("data:image/png;base64,", "#"))
    ]
    assert outside == []
    inside = [ref[1:] for ref in page.references if ref.startswith("#")]
    assert set(inside) <= set(page.ids)
    assert len(page.ids) == len(set(page.ids))


def test_style_brings_nothing_from_outside_either(files):
    html = report_page([files["run"]], "run.html")
    (style,) = re.findall(r"<style>(.*?)</style>", html, re.DOTALL)
    assert "url(" not in style
    assert "@import" not in style
    assert "default-src 'none'" in html


def test_every_picture_is_whole_and_says_what_it_shows(page):
    assert len(page.pictures) == len(page.alts) > 10
    assert all(page.alts)
    for picture in page.pictures:
        picture.load()
        assert picture.width >= 1000
        colours = np.asarray(picture.convert("L"))
        assert colours.min() < 100 < colours.max()


def test_what_was_run_stands_there_with_command_seeds_and_software(page, files):
    assert "dnnmso sweep paper …" in page.text
    assert "dnnmso report sweep.parquet compare.parquet margins.parquet run.mcap" in page.text
    _, provenance = read_table(files["sweep"])
    for name, version in provenance["software"].items():
        assert f"{name} = {version}" in page.text
    assert "0:7" in page.text
    assert provenance["definition"]["source_sha256"] in page.text


def test_failures_are_listed_with_seed_and_reason(files):
    table, _ = read_table(files["sweep"])
    bad = [row for row in table.to_pylist() if row["status"] == "diverged"]
    assert len(bad) == 7  # as_printed
    text = Page(report_page([files["sweep"]], "x.html")).text
    for row in bad:
        assert f"{row['seed']} diverged {row['reason']}" in text
    assert "feedback = as_printed 7 0 7 0" in text


def test_the_medians_of_a_sweep_are_those_of_its_table(files):
    table, _ = read_table(files["sweep"])
    good = [row["rmse_steady"] for row in table.to_pylist() if row["status"] == "ok"]
    text = Page(report_page([files["sweep"]], "x.html")).text
    assert f"feedback = stable 7 7 0 0 {np.median(good):.4g} [" in text


def test_a_comparison_is_paired_with_its_first_controller(files):
    table, _ = read_table(files["compare"])
    rows = {(row["controller"], row["seed"]): row["rmse_steady"] for row in table.to_pylist()}
    ratios = [rows["dnn_mso", seed] / rows["no_network", seed] for seed in range(7)]
    text = Page(report_page([files["compare"]], "x.html")).text
    assert "rmse_steady against no_network" in text
    assert f"dnn_mso {np.median(ratios):.4g} " in text
    wins = sum(ratio < 1 for ratio in ratios)
    assert f" {wins} {7 - wins} 0 " in text


def test_margins_have_a_matrix_cards_and_their_limit(files):
    text = Page(report_page([files["margins"]], "x.html")).text
    assert "Margin card of no_network" in text
    assert "rmse_steady ≤ 0.5 rad" in text
    assert "model_above uses none" in text
    assert "without a model no_network" in text


def test_a_log_shows_its_metrics_and_scenario(files):
    text = Page(report_page([files["run"]], "x.html")).text
    assert "Run of paper, seed 0" in text
    for name in METRICS:
        assert name in text


def test_every_metric_of_a_table_is_defined():
    assert list(METRICS) == list(METRIC_TYPES)


def test_the_same_files_give_the_same_bytes(files, tmp_path):
    one, other = tmp_path / "report.html", tmp_path / "again" / "report.html"
    write_report(list(files.values()), one)
    write_report(list(files.values()), other)
    assert one.read_bytes() == other.read_bytes()
    assert (
        list(tmp_path.iterdir()) == [tmp_path / "again", one] or len(list(tmp_path.iterdir())) == 2
    )


def test_names_and_reasons_are_text_whatever_they_hold(files, tmp_path):
    table, provenance = read_table(files["sweep"])
    provenance["command"] = HOSTILE
    provenance["definition"]["points"][0]["scenario"]["name"] = f'"{HOSTILE}'
    reasons = pa.array([HOSTILE + "\x00\x1b[31m"] * len(table))
    table = table.set_column(table.column_names.index("reason"), "reason", reasons)
    hostile = tmp_path / "<script>x.parquet"
    metadata = {METADATA_KEY: json.dumps(provenance)}
    pq.write_table(table.replace_schema_metadata(metadata), hostile)
    html = report_page([hostile], "<b>.html")
    page = Page(html)
    assert "script" not in page.tags
    assert "b" not in page.tags
    assert HOSTILE in page.text
    assert "\x00" not in html
    assert "\x1b" not in html


def test_every_text_of_a_section_is_escaped():
    blocks = [TableBlock(HOSTILE, [HOSTILE], [[HOSTILE]], HOSTILE), TextBlock(HOSTILE, HOSTILE)]
    section = Section(HOSTILE, [(HOSTILE, HOSTILE)], blocks, notes=[HOSTILE])
    page = Page(render(HOSTILE, HOSTILE, [section, section]))
    assert "script" not in page.tags
    assert page.text.count("alert") == 2 * (9 + 1) + 4  # and the list of sections


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"name: paper\n", "neither a table nor a log; allowed: a table of `dnnmso sweep`"),
        (b"", "neither a table nor a log"),
        (b"PAR1 torn", "damaged"),
        (b"\x89MCAP0\r\n", "no log|holds|not"),
    ],
)
def test_other_files_are_refused_and_nothing_is_written(content, says, tmp_path):
    file, out = tmp_path / "file.parquet", tmp_path / "report.html"
    file.write_bytes(content)
    with pytest.raises(DnnmsoError, match=says):
        write_report([file], out)
    assert not out.exists()


def test_a_table_of_nobody_and_a_damaged_one_are_refused(files, tmp_path):
    foreign, damaged = tmp_path / "foreign.parquet", tmp_path / "damaged.parquet"
    pq.write_table(pa.table({"x": [1]}), foreign)
    with pytest.raises(ReportError, match="a table that no command of dnnmso wrote"):
        report_page([foreign], "x.html")
    table, _ = read_table(files["sweep"])
    pq.write_table(table.replace_schema_metadata({METADATA_KEY: "{}"}), damaged)
    with pytest.raises(ReportError, match="damaged: KeyError: 'definition'"):
        report_page([damaged], "x.html")


def test_a_page_is_not_written_over_what_it_reads(files):
    with pytest.raises(ReportError, match="is one of the files"):
        write_report([files["sweep"]], files["sweep"])
    assert read_table(files["sweep"])


def test_the_command_writes_the_page_and_refuses_what_is_none(files, tmp_path):
    done = dnnmso("report", files["margins"], "--out", "page.html", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "page.html"
    Page((tmp_path / "page.html").read_text(encoding="utf-8"))
    refused = dnnmso("report", "nothing.parquet", cwd=tmp_path)
    assert refused.returncode == 2
    assert refused.stderr.startswith("error: nothing.parquet: cannot be read: No such file")
