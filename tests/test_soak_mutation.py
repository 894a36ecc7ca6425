"""Mutation testing, and that it tells a noticed mutant from one that is not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from soak.mutants import Mutant, mutants_of, original
from soak.mutation import EXPLAINED, TESTS, Verdict, account, explanations, judge
from soak.proof import prove
from soak.tally import Tally


def mutant(file: str, after: str) -> Mutant:
    """The one whose changed line is this."""
    (found,) = (each for each in mutants_of(file) if each.after == after)
    return found


def test_broken_mathematics_fails_a_test(tmp_path: Path) -> None:
    prove(15, tmp_path)


def doing(what: str) -> Mutant:
    """The observer, doing something when it starts."""
    same = original("observer.py")
    source = same.source.replace("copy(x, observer.x_hat)", f"{what}; copy(x, observer.x_hat)")
    return replace(same, source=source, after=what)


def test_outcomes_are_what_was_done_to_the_source(tmp_path: Path) -> None:
    flipped = "rate = f_hat[i] + Bu[i] - observer.gain[i] * observer.e_obs[i]"
    cases = {
        mutant("observer.py", flipped): "killed",
        doing("pass"): "survived",
        doing("__import__('time').sleep(1e6)"): "timed out",
        doing("bytearray(2**32)"): "killed",
        doing("__import__('os').kill(0, 9)"): "killed",
        mutant("dynamics.py", "gravity: float = 10.81"): "survived",  # none of its tests is run
    }
    tests = {"observer.py": ("test_observer.py::test_the_observer",), "dynamics.py": ()}
    tests["observer.py"] += ("test_observer.py::test_correcting",)
    verdicts = judge(list(cases), tests, tmp_path)
    assert {verdict.mutant: verdict.outcome for verdict in verdicts} == cases
    tally = Tally()
    account(verdicts, {}, tally, whole=False)
    assert (tally.survived, len(tally.lost)) == (4, 2)
    assert "dynamics.py" in tally.lost[1]
    assert tally.figures["all"]["timed out"] == 1
    assert tally.figures["observer.py"]["score"] == 0.8
    assert not tally.passed


def test_a_test_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="no test is named test_observer"):
        judge(
            [original("observer.py")], {"observer.py": ["test_observer.py::test_nothing"]}, tmp_path
        )


def test_a_survivor_is_excused_by_its_explanation_alone() -> None:
    one, other = original("observer.py"), original("inversion.py")
    verdicts = [Verdict(each, "survived", "", 1.0) for each in (one, other)]
    verdicts.append(Verdict(one, "broken", "", 1.0))
    gone = ("kernel.py", "learn", "a", "b")
    tally = Tally()
    account(verdicts, {one.key: "why", gone: "why"}, tally, whole=True)
    assert tally.survived == 1
    assert [what.partition(":")[0] for what in tally.lost] == [
        "survived",
        "broken",
        "explained, but no mutant that survives",
    ]
    assert tally.figures["observer.py"] == {
        "mutants": 2,
        "killed": 0,
        "timed out": 0,
        "survived": 2,
        "explained": 1,
        "score": 0.0,
    }


def test_every_explanation_is_of_a_mutant_there_is_and_gives_a_reason() -> None:
    keys = {each.key for file in TESTS for each in mutants_of(file)}
    explained = explanations(EXPLAINED)
    assert explained.keys() <= keys
    assert all(len(reason) > 20 for reason in explained.values())


def test_an_explanation_without_a_reason_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "explained.txt"
    several = "kernel.py\n- c\n+ d\n+ e\n- e\n+ f\nWhy\nnot.\n"
    path.write_text(f"# note\nkernel.py learn\n- a\n+ b\nSame.\n\n{several}")
    assert explanations(path) == {
        ("kernel.py", "learn", "a", "b"): "Same.",
        ("kernel.py", "", "c", "d"): "Why not.",
        ("kernel.py", "", "c", "e"): "Why not.",
        ("kernel.py", "", "e", "f"): "Why not.",
    }
    path.write_text("kernel.py learn\n- a\n+ b\n")
    with pytest.raises(AssertionError, match="no reason"):
        explanations(path)


def test_mutants_are_made_in_compiled_functions_properties_and_constants() -> None:
    places = {(each.file, each.function) for file in TESTS for each in mutants_of(file)}
    assert {
        ("kernel.py", "_madam_row"),
        ("dynamics.py", "TwoLink._lumped"),
        ("kernel.py", ""),
        ("recording.py", "McapRecorder._writing"),
    } <= places
    lines = [each.after for each in mutants_of("kernel.py")]
    assert {"z[i] = min(z[i], zero)", "if not (by_output):", "_times_slope(delta, a)"} & set(lines)
