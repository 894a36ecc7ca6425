"""Row 13 in short, what it rests on, and that its checkers see what is broken."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest
from soak import concurrency
from soak.forked import Told
from soak.proof import prove

from dnnmso_mj import files
from dnnmso_mj.errors import LogError
from dnnmso_mj.files import name_new, open_beside, whole_file, write_whole
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.log.place import Place
from dnnmso_mj.run import run_logged

MAGIC = b"\x89MCAP0\r\n"


@pytest.mark.alone
def test_two_writers_of_one_name_never_mix(tmp_path):
    prove(13, tmp_path)


# ---- files


def test_of_many_who_give_one_name_one_succeeds(tmp_path):
    parts = [open_beside(tmp_path / "x") for _ in range(16)]
    won = []

    def give(part: Path) -> None:
        try:
            name_new(part, tmp_path / "x")
        except FileExistsError:
            return
        won.append(part)

    threads = [threading.Thread(target=give, args=(part,)) for _, part in parts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for file, _ in parts:
        file.close()
    assert len(won) == 1


def test_without_hard_links_a_name_is_given_once_too(tmp_path, monkeypatch):
    def refuse(*_paths: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    for text in (b"first", b"second"):
        file, part = open_beside(tmp_path / "x")
        with file:
            file.write(text)
        if text == b"first":
            name_new(part, tmp_path / "x")
        else:
            with pytest.raises(FileExistsError):
                name_new(part, tmp_path / "x")
    assert (tmp_path / "x").read_bytes() == b"first"


def test_a_file_that_is_not_finished_has_no_name(tmp_path):
    (tmp_path / "x").write_bytes(b"old")

    def fail() -> None:
        with whole_file(tmp_path / "x") as file:
            file.write(b"half")
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        fail()
    assert [path.name for path in tmp_path.iterdir()] == ["x"]
    assert (tmp_path / "x").read_bytes() == b"old"


def test_a_link_planted_where_a_file_is_begun_is_not_followed(tmp_path, monkeypatch):
    monkeypatch.setattr(files.secrets, "token_hex", lambda _size: "known")
    canary = tmp_path / "canary"
    (tmp_path / ".dnnmso-known.part").symlink_to(canary)
    with pytest.raises(FileExistsError):
        write_whole(tmp_path / "x", b"text")
    assert not canary.exists()


def test_a_file_has_the_rights_that_any_other_has(tmp_path):
    (tmp_path / "usual").touch()
    write_whole(tmp_path / "x", b"")
    assert (tmp_path / "x").stat().st_mode == (tmp_path / "usual").stat().st_mode


# ---- the name of a log


def taken(path: Path, force: bool = False) -> Place:
    place = Place(path, force)
    place.file.write(MAGIC)
    place.file.flush()
    place.take()
    return place


def test_a_log_has_no_name_before_it_has_begun(tmp_path):
    place = Place(tmp_path / "run.mcap")
    assert not (tmp_path / "run.mcap").exists()
    place.give_up()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("force", [False, True])
def test_a_log_that_is_being_written_is_not_replaced(tmp_path, force):
    first = taken(tmp_path / "run.mcap")
    with pytest.raises(LogError, match="another run is writing it now"):
        Place(tmp_path / "run.mcap", force)
    assert first.is_there
    first.file.close()
    if force:
        assert taken(tmp_path / "run.mcap", force).is_there


def test_of_two_that_replace_a_log_the_second_sees_the_first(tmp_path):
    taken(tmp_path / "run.mcap").file.close()
    one, other = (Place(tmp_path / "run.mcap", force=True) for _ in range(2))
    for place in (one, other):
        place.file.write(MAGIC)
        place.file.flush()
    one.take()
    with pytest.raises(LogError, match="another run is writing it now"):
        other.take()
    assert one.is_there
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


# ---- negative controls


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    done = [
        run_logged(load_scenario("paper", ["duration=0.2", f"seed={k}"]), folder / f"{k}.mcap")
        for k in range(2)
    ]
    return concurrency.Runs([each.trace for each in done], done[0].log)


def test_two_logs_in_one_file_are_seen(runs, tmp_path):
    mixed = tmp_path / "mixed.mcap"
    one, other = (runs.log.with_name(f"{k}.mcap").read_bytes() for k in range(2))
    half = len(one) // 2
    mixed.write_bytes(one[:half] + other[half:])
    with pytest.raises(AssertionError, match="not whole"):
        concurrency.whole(mixed, [0], runs)


def test_the_log_of_another_run_is_seen(runs):
    with pytest.raises(AssertionError, match="the log is of seed 0"):
        concurrency.whole(runs.log, [1], runs)


@pytest.mark.parametrize(
    "told",
    [
        Told(2, "", "error: run.mcap is taken"),
        Told(1, "", "error: run.mcap is taken. Choose another name"),
        Told(2, "", "error: it is taken. Choose another name"),
        Told(2, "", "Traceback\nerror: run.mcap is taken. Choose another name"),
    ],
)
def test_an_impolite_refusal_is_seen(told):
    assert not concurrency.refused(told, Path("run.mcap"))
