"""Row 10, and that what it looks for is found: a last bit, a hash that is another one."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from soak import golden
from soak.determinism import Known, compare, forked
from soak.proof import prove
from soak.sameness import columns_digest, digest, log_digest
from soak.tally import Tally

from dnnmso_mj import Trace, load_scenario, run_logged, simulate
from dnnmso_mj.difference import CLOCKED
from dnnmso_mj.trace import Event


@pytest.fixture(scope="module")
def trace() -> Trace:
    return simulate(load_scenario("paper", ["duration=0.05"]))


def test_a_run_is_the_same_however_it_is_run(tmp_path: Path) -> None:
    prove(10, tmp_path)


def test_the_last_bit_of_one_number_of_any_column_is_noticed(trace: Trace) -> None:
    tally, known = Tally(), Known({}, {"paper": digest(trace)})
    names = [name for name in trace if name not in CLOCKED]
    for name in names:
        columns = {each: column.copy() for each, column in trace.columns.items()}
        flat = columns[name].reshape(-1)
        k = flat.size // 2
        flat[k] = ~flat[k] if flat.dtype == bool else np.nextafter(flat[k], np.inf)
        compare(tally, name, {"paper": digest(replace(trace, columns=columns))}, known)
    assert len(tally.lost) == len(names) == len(trace.columns) - len(CLOCKED)
    assert tally.survived == 0


def test_the_wall_clock_is_no_difference(trace: Trace) -> None:
    columns = dict(trace.columns) | {name: trace[name] + 1.0 for name in CLOCKED}
    assert columns_digest(replace(trace, columns=columns)) == columns_digest(trace)


def test_a_status_or_an_event_is_a_difference(trace: Trace) -> None:
    assert digest(replace(trace, info=replace(trace.info, status="diverged"))) != digest(trace)
    happened = replace(trace, events=(Event(0.01, "info", "a push"),))
    assert digest(happened) != digest(trace)
    assert digest(replace(happened, events=(Event(0.011, "info", "a push"),))) != digest(happened)


def test_logs_of_the_same_run_have_the_same_bytes_and_others_do_not(tmp_path: Path) -> None:
    found = [
        log_digest(run_logged(load_scenario("paper", ["duration=0.1", *sets]), tmp_path / out).log)
        for out, sets in (("a", []), ("b", []), ("c", ["initial.q=[1.0000000000000002, 1.0]"]))
    ]
    assert found[0] == found[1] != found[2]


def test_what_a_forked_process_does_not_say_is_no_run() -> None:
    def fail() -> str:
        raise ValueError

    assert forked(lambda: "said") == "said"
    assert forked(fail) == "no run"


def test_golden_hashes_hold_here_or_it_is_said_how_to_make_them() -> None:
    kept, key = golden.known().get(golden.key()), golden.key()
    assert all(name in key for name in (*golden.PACKAGES, "python"))
    if kept is None:
        assert key in golden.missing()
        assert golden.missing().endswith("make golden")
    else:
        assert golden.differing(kept, golden.measured()) == []


def test_a_golden_hash_that_was_changed_fails() -> None:
    kept = {"paper": "a" * 64, "hard": "b" * 64}
    assert golden.differing(kept, dict(kept)) == []
    [said] = golden.differing(kept, kept | {"hard": "b" * 63 + "c"})
    assert said.startswith("hard: ")
    assert "make golden" in said
    assert golden.differing(kept, {"paper": "a" * 64})
    assert golden.differing({}, kept)


def test_golden_hashes_of_other_machines_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "golden.json"
    file.write_text(json.dumps({"another machine": {"paper": "a"}}))
    monkeypatch.setattr(golden, "FILE", file)
    monkeypatch.setattr(golden, "measured", lambda: {"paper": "b"})
    golden.main()
    expected = {"another machine": {"paper": "a"}, golden.key(): {"paper": "b"}}
    assert json.loads(file.read_text()) == expected
