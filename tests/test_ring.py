"""The ring between a run and the process that streams it: in order, bounded, never waiting."""

from __future__ import annotations

import mmap
import os

import numpy as np
import pytest

from dnnmso_mj.viewer.ring import Ring, shared_memory

FRAME = 16  # bytes before each message


def both_ends(capacity: int) -> tuple[Ring, Ring]:
    """A writer's ring and its reader's, over memory of their own."""
    memory = shared_memory(capacity)
    writer, reader = Ring(memory), Ring(memory)
    os.close(memory)
    return writer, reader


def test_messages_come_out_as_they_went_in_however_often_the_ring_is_gone_round():
    rng = np.random.default_rng(0)
    writer, reader = both_ends(1000)
    sent, got = [], []
    for k in range(500):
        message = rng.bytes(int(rng.integers(0, 120)))
        assert writer.put(k, message)
        sent.append((k, message))
        if rng.random() < 0.4 or k % 5 == 4:
            got += reader.take(10_000)
    got += reader.take(10_000)
    assert got == sent


def test_a_full_ring_refuses_and_takes_again_when_there_is_room():
    writer, reader = both_ends(2 * (FRAME + 100))
    assert writer.put(0, bytes(100))
    assert writer.put(1, bytes(100))
    assert not writer.put(2, b"")
    assert [kind for kind, _ in reader.take(1)] == [0]
    assert writer.put(3, bytes(100))
    assert [kind for kind, _ in reader.take(10_000)] == [1, 3]


def test_a_message_larger_than_the_ring_is_refused():
    writer, reader = both_ends(100)
    assert not writer.put(0, bytes(101))
    assert list(reader.take(10_000)) == []


def test_what_the_reader_says_reaches_the_writer():
    writer, reader = both_ends(100)
    reader.tally += 50
    assert writer.tally == 50
    assert not writer.closed
    reader.close()
    assert writer.closed
    assert not writer.put(0, b"")


def test_warming_keeps_what_is_there_nowhere_and_breaks_nothing():
    writer, reader = both_ends(10 * mmap.PAGESIZE)
    writer.warm(1000 * mmap.PAGESIZE)  # more than there is
    assert writer.put(7, b"after")
    assert list(reader.take(100)) == [(7, b"after")]


def test_without_memfd_a_file_that_nobody_sees_does(monkeypatch: pytest.MonkeyPatch, tmp_path):
    monkeypatch.delattr(os, "memfd_create")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    writer, reader = both_ends(100)
    assert writer.put(1, b"through a file")
    assert list(reader.take(100)) == [(1, b"through a file")]
    assert not list(tmp_path.iterdir())
