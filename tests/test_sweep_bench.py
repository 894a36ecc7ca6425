"""The pool that a sweep is timed against."""

from __future__ import annotations

import pytest

from dnnmso_mj.bench.tick import paper
from dnnmso_mj.bench.torch_loop import pool_of_loops
from dnnmso_mj.errors import DnnmsoError


def test_the_pool_yields_the_ticks_of_every_run():
    assert list(pool_of_loops(paper(20), 2, range(3))) == [20, 20, 20]


def test_a_pool_whose_processes_cannot_start_is_an_error_not_an_endless_loop(tmp_path, monkeypatch):
    (tmp_path / "numpy.py").write_text("raise SystemExit(7)")
    monkeypatch.syspath_prepend(tmp_path)  # which spawned processes take over
    with pytest.raises(DnnmsoError, match="PyTorch loops cannot start"):
        list(pool_of_loops(paper(20), 2, range(3)))
