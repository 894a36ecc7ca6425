"""What is read from outside, fuzzed; and the check of that, given a target that is broken."""

from __future__ import annotations

import base64

import log_samples
import pytest
from soak.fuzz_guard import Guard
from soak.fuzzing import Job, count, fuzz
from soak.mcap_surgery import put_together, take_apart
from soak.proof import prove
from soak.tally import Tally


@pytest.mark.alone
def test_fuzzed_input_gives_typed_errors_only(tmp_path):
    pytest.importorskip("atheris")
    prove(7, tmp_path)


def test_a_broken_target_is_lost_in_each_way_that_it_is_broken(tmp_path):
    """A KeyError, a second too long, 300 MB too much, and the end of the process."""
    pytest.importorskip("atheris")
    found = fuzz(Job("planted", 50, 1000), tmp_path)
    inputs = [base64.b64decode(failure.input) for failure in found.failures.values()]
    for word in (b"key", b"slow", b"big", b"die"):
        assert any(word in data for data in inputs), (word, found.failures)
    tally = Tally()
    count("planted", [found], tally)
    assert not tally.passed


@pytest.mark.parametrize(
    ("bug", "way"), [("key", "KeyError"), ("slow", "slow: took 1."), ("big", "large: took 3")]
)
def test_each_bug_is_told_with_what_provokes_it(tmp_path, bug, way):
    from soak.fuzz_planted import target

    guard = Guard(target(tmp_path), tmp_path / "now.bin")
    for data in (b"fine", bug.encode(), b"fine"):
        guard(data)
    [failure] = guard.found.failures.values()
    assert way in failure.what
    assert base64.b64decode(failure.input) == bug.encode()
    assert (guard.found.cases, guard.found.lost, guard.found.refused) == (3, 1, 2)


def test_what_cannot_be_printed_is_no_message(tmp_path):
    from dnnmso_mj.errors import ScenarioError

    def refuses(data: bytes) -> None:
        raise ScenarioError(data.decode("utf-8", "surrogateescape"))

    guard = Guard(refuses, tmp_path / "now.bin")
    for data in (b"a reason", b"\xff", b""):
        guard(data)
    assert (guard.found.refused, guard.found.lost) == (1, 2)


def test_surgery_puts_a_log_together_as_it_was(tmp_path):
    log_samples.write_log(tmp_path / "a.mcap", 40)
    data = (tmp_path / "a.mcap").read_bytes()
    assert put_together(take_apart(data)) == data
