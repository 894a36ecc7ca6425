"""Torn and flipped logs are read as far as they are right; and the check of that can fail."""

from __future__ import annotations

from pathlib import Path

import pytest
from log_samples import write_log
from soak import log_damage, log_made, log_tables
from soak.proof import prove
from soak.tally import Tally
from soak.torn_logs import Readers

from dnnmso_mj.errors import LogError
from dnnmso_mj.log.prefix import Prefix
from dnnmso_mj.log.records import DamagedError, Fields
from dnnmso_mj.reading import log_info, read_snapshots, read_trace


def test_torn_and_flipped_logs_give_a_prefix_or_one_error(tmp_path):
    prove(5, tmp_path)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("torn") / "good.mcap"
    write_log(path, 400)
    return path


def judged(log: Path, path: Path, kind: str, broken: str | None) -> Tally:
    tally = Tally()
    readers = Readers(log, tally, broken, 1)
    try:
        readers.judge("one log", path, kind)
    finally:
        readers.close()
    return tally


def flipped_chunk(log: Path, path: Path) -> Path:
    """The log with one bit of a chunk in its middle flipped."""
    data = log.read_bytes()
    parts = log_damage.regions(data)["compressed data"]
    start, end = parts[len(parts) // 2]
    path.write_bytes(log_damage.flipped(data, [4 * (start + end)], "").data)
    return path


@pytest.mark.parametrize(("broken", "lost"), [(None, 0), ("leave out", 1)])
def test_a_reader_that_leaves_out_a_damaged_chunk_is_caught(log, tmp_path, broken, lost):
    path = flipped_chunk(log, tmp_path / "flipped.mcap")
    tally = judged(log, path, "damaged", broken)
    assert len(tally.lost) == lost, tally.lost
    assert not lost or "is not the original's" in tally.lost[0]


@pytest.mark.parametrize(("broken", "lost"), [(None, 0), ("unbound", 1)])
def test_a_reader_without_a_bound_of_memory_is_caught(log, tmp_path, broken, lost):
    path = tmp_path / "bomb.mcap"
    log_made.makers()["a chunk of 200 MB of zeros"](path)
    tally = judged(log, path, "made", broken)
    assert len(tally.lost) == lost, tally.lost
    assert not lost or "MB for a file of 0." in tally.lost[0]


def test_a_reader_that_calls_a_damaged_log_whole_is_caught(log, tmp_path):
    path, data = tmp_path / "summary.mcap", log.read_bytes()
    start, end = log_damage.regions(data)["summary"][0]
    path.write_bytes(log_damage.flipped(data, [4 * (start + end)], "").data)
    assert not judged(log, path, "damaged", None).lost
    assert "complete: True" in judged(log, path, "damaged", "believe").lost[0]


def test_a_table_with_other_numbers_is_caught(tmp_path):
    good, other = log_tables.table(), log_tables.table()
    log_tables.write_table(other.slice(1), tmp_path / "other.parquet")
    tally = Tally()
    log_tables.judge("another table", tmp_path / "other.parquet", good, tally)
    assert len(tally.let_in) == 1


@pytest.mark.parametrize("region", ["summary", "footer", "data end", "message index", "header"])
def test_a_flip_beside_the_data_costs_no_tick_but_the_name_of_a_whole_log(log, tmp_path, region):
    path, data = tmp_path / "flipped.mcap", log.read_bytes()
    _, end = log_damage.regions(data)[region][0]
    path.write_bytes(log_damage.flipped(data, [8 * end - 1], "").data)
    assert not log_info(path).complete
    if region in ("summary", "footer", "data end", "header"):
        assert len(read_trace(path)) == 400


def test_a_chunk_that_a_flipped_bit_calls_an_index_ends_the_prefix(log, tmp_path):
    path, data = tmp_path / "flipped.mcap", log.read_bytes()
    starts = [at for kind, at, _ in log_damage.records(data) if kind == log_damage.CHUNK]
    path.write_bytes(log_damage.flipped(data, [8 * starts[2]], "").data)  # 6 becomes 7
    assert 0 < len(read_trace(path)) < 200


def test_a_chunk_that_is_gone_with_its_indexes_ends_the_prefix(log, tmp_path):
    path, data = tmp_path / "spliced.mcap", log.read_bytes()
    _, (start, end), *_ = log_damage._chunks(data)
    path.write_bytes(data[:start] + data[end:])
    ticks = len(read_trace(path))
    assert 0 < ticks < 200
    assert not log_info(path).complete


def test_a_log_that_is_cut_while_it_is_read_gives_what_was_read(log, tmp_path):
    path, data = tmp_path / "cut.mcap", log.read_bytes()
    path.write_bytes(data)
    prefix = Prefix(path)
    found = []
    for record in prefix:
        found.append(record)
        path.write_bytes(data[: len(data) // 2])
    assert found
    assert not prefix.complete


@pytest.mark.parametrize("name", ["npz of 100 MB of zeros", "npz of a giant shape"])
def test_a_snapshot_that_would_grow_is_refused(tmp_path, name):
    path = tmp_path / "made.mcap"
    log_made.makers()[name](path)
    with pytest.raises(LogError, match="is no npz file of plain arrays"):
        read_snapshots(path)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("unnumbered ticks with a gap", "ticks are missing, or not in their order"),
        ("a scenario of many lists", "bytes of metadata"),
        ("a deep scenario", "its scenario is not one of this version|of 100000 characters"),
        ("a metric 'NaN'", "metric"),
        ("a scenario of three joints", "3 joints"),
        ("laid out by another program", "another program's layout"),
    ],
)
def test_what_is_wrong_with_a_made_log_is_said(tmp_path, name, message):
    path = tmp_path / "made.mcap"
    log_made.makers()[name](path)
    with pytest.raises(LogError, match=message):
        read_trace(path)


def test_a_field_that_ends_behind_its_record_is_damage():
    with pytest.raises(DamagedError, match="ends behind its record"):
        Fields(b"\xff\xff\xff\xff").text()
