"""The scorecard itself: what is lost, let in, broken off or left out never counts as passed."""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path
from typing import Any

import pytest
from soak import scorecard
from soak.proof import measure, measure_apart
from soak.rows import ROWS, Row
from soak.tally import Form, Tally


def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str) -> dict[str, Any]:
    """What a row says whose function has this body."""
    package = Path(sys.modules["soak"].__path__[0])
    monkeypatch.setattr(sys.modules["soak"], "__path__", [str(package), str(tmp_path)])
    monkeypatch.delitem(sys.modules, "soak.a_row", raising=False)
    code = f"def run(form, tally, folder):\n{textwrap.indent(textwrap.dedent(body), '    ')}\n"
    (tmp_path / "a_row.py").write_text(code)
    return measure(Row(1, "a_row", "a row", 60), Form(), tmp_path)


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("tally.survive(3)", "passed"),
        ("tally.survive(3)\ntally.lose('a tick')", "FAILED"),
        ("tally.survive(3)\ntally.admit('a file')", "FAILED"),
        ("tally.survive(3)\ntally.leave_out('an audit', 'no network')", "not all run"),
        ("tally.leave_out('all of it', 'no screen')", "not run"),
        ("pass", "not run"),
        ("tally.survive(3)\nraise OSError('gone')", "FAILED"),
        ("with tally.case('one'):\n    assert 1 == 2", "FAILED"),
    ],
)
def test_only_what_was_all_run_and_all_held_passes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str, said: str
) -> None:
    assert scorecard.verdict(made(tmp_path, monkeypatch, body)) == said


def test_a_row_whose_process_dies_or_hangs_is_lost() -> None:
    endless = Row(1, "non_finite", "a row", 0.01)
    found = measure_apart(endless, Form())
    assert found["lost"] == 1
    assert "not done after 0.01 s" in found["lost_first"][0]
    found = measure_apart(Row(99, "no_row", "a row", 60.0), Form())
    assert "ended with status 2" in found["lost_first"][0]


def test_a_case_is_lost_with_its_reason() -> None:
    tally = Tally()
    with tally.case("tick 7"):
        raise ValueError("not a number\nat all")
    assert tally.lost == ["tick 7: ValueError: not a number"]
    assert tally.tried == 1


def test_the_page_shows_what_was_measured_and_what_was_not(tmp_path: Path) -> None:
    results, page = tmp_path / "r.json", tmp_path / "r.md"
    page.write_text(f"before\n{scorecard.BEGIN}old\n{scorecard.END}after\n")
    tally = {"tried": 5, "survived": 5, "lost": 0, "let_in": 0, "passed": False, "seconds": 1.0}
    lists: dict[str, Any] = {"lost_first": [], "let_in_first": [], "figures": {"worst (s)": 0.05}}
    found = {"row": 2, "title": "two", "seed": 0, "not_run": {"a": "b"}, **tally, **lists}
    scorecard.keep(found, results, page)
    scorecard.keep(found | {"tried": 6}, results, page)
    text = page.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "| 2 | two | 6 | 5 | 0 | 0 | not all run | 1 |" in text
    assert "- worst (s): 0.05" in text
    assert "- not run: a: b" in text
    assert text.count("| not run |") == len(ROWS) - 1


def test_the_page_is_made_of_the_results() -> None:
    text = scorecard.PAGE.read_text()
    table = text.partition(scorecard.BEGIN)[2].partition(scorecard.END)[0]
    assert table == scorecard.markdown(scorecard.read())


def test_all_rows_together_end_within_two_hours() -> None:
    assert [row.number for row in ROWS] == list(range(1, 16))
    compiling = 300.0
    assert compiling + sum(row.limit_s for row in ROWS) <= 7200
