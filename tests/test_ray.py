"""Sweeps on Ray: a real cluster of several nodes, one of which is killed in mid-sweep."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from soak.sockets import watched
from sweep_samples import (
    DEADLY_SEED,
    Deadly,
    dnnmso,
    foreign_modules,
    small_plan,
    untimed,
    with_scenario,
)

from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.sweep import on_ray
from dnnmso_mj.sweep.local import LocalEngine
from dnnmso_mj.sweep.on_ray import RayEngine
from dnnmso_mj.sweep.plan import Plan, plan_sweep
from dnnmso_mj.sweep.run import run_sweep
from dnnmso_mj.sweep.task import Task


@pytest.fixture(scope="module")
def cluster() -> Iterator[object]:
    """A head that runs nothing, and two nodes of one core, each of processes of its own."""
    from ray.cluster_utils import Cluster

    before = os.environ.get("PYTHONPATH", "")
    # Nodes find this folder's modules, as they would an installed package.
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(Path(__file__).parent), before]))
    cluster = Cluster()
    try:
        cluster.add_node(num_cpus=0, include_dashboard=False)
        for _ in range(2):
            cluster.add_node(num_cpus=1)
        yield cluster
    finally:
        os.environ["PYTHONPATH"] = before
        cluster.shutdown()


class KillsANode:
    """Looks on, and ends a node of a cluster by SIGKILL after some rows."""

    def __init__(self, cluster, after: int) -> None:
        self.cluster, self.after, self.rows = cluster, after, 0
        self.killed = None

    def begin(self, total: int, kept: int) -> None:
        pass

    def row(self, row) -> None:
        self.rows += 1
        if self.rows == self.after:
            self.killed = self.cluster.list_all_nodes()[-1]
            processes = [
                info.process for many in self.killed.all_processes.values() for info in many
            ]
            self.cluster.remove_node(self.killed, allow_graceful=False)
            assert processes
            assert all(process.poll() is not None for process in processes)


def local(plan: Plan, folder: Path) -> pa.Table:
    return run_sweep(plan, folder / "local.parquet", LocalEngine(2)).table


def test_a_cluster_gives_the_same_table_as_this_machine(cluster, tmp_path):
    plan = small_plan()
    result = run_sweep(plan, tmp_path / "x.parquet", RayEngine(address=cluster.address))
    assert result.jobs == 2
    assert untimed(result.table).equals(untimed(local(plan, tmp_path)))


def test_a_run_that_kills_its_process_is_a_row_and_its_task_is_run_one_by_one(cluster):
    point = with_scenario(small_plan(1), Deadly).points[0]
    task = Task(0, point.scenario, point.mjcf, tuple(range(5)))
    rows = {row["seed"]: row for row in RayEngine(address=cluster.address).rows([task])}
    assert sorted(rows) == [0, 1, 2, 3, 4]
    culprit = rows.pop(DEADLY_SEED)
    assert culprit["status"] == "failed"
    assert culprit["reason"].startswith("its task was lost: WorkerCrashedError")
    assert {row["status"] for row in rows.values()} == {"ok"}


def test_a_machine_with_other_software_ends_the_sweep_and_keeps_its_rows(
    cluster, tmp_path, monkeypatch
):
    monkeypatch.setattr(on_ray, "_versions", lambda: {"mujoco": "3.0.0"})
    with pytest.raises(DnnmsoError, match=r"has dnnmso_mj .*; allowed: .* mujoco 3\.0\.0"):
        run_sweep(small_plan(), tmp_path / "x.parquet", RayEngine(address=cluster.address))


def test_ray_that_the_caller_has_started_is_left_alone(cluster):
    import ray

    point = small_plan().points[0]
    ray.init(address=cluster.address, log_to_driver=False, logging_level=logging.ERROR)
    try:
        with pytest.raises(DnnmsoError, match="this machine: no Ray there"):
            next(RayEngine().rows([Task(0, point.scenario, point.mjcf, (0,))]))
        assert ray.is_initialized()
    finally:
        ray.shutdown()


def test_every_row_is_there_although_a_node_is_killed_in_mid_sweep(cluster, tmp_path):
    plan = plan_sweep("paper", range(60), ["duration=1"])
    watcher = KillsANode(cluster, after=20)
    engine = RayEngine(address=cluster.address)
    result = run_sweep(plan, tmp_path / "x.parquet", engine, watcher=watcher)
    assert watcher.killed is not None
    assert set(result.table["status"].to_pylist()) == {"ok"}
    assert untimed(result.table).equals(untimed(local(plan, tmp_path)))


def test_the_command_starts_ray_by_itself_for_this_machine_alone_and_prints_nothing_else(tmp_path):
    foreign_modules(tmp_path)  # which no worker shall import
    args = ("sweep", "paper", "--seeds", "0:4", "--set", "duration=0.1", "--out", "x.parquet")
    args = (*args, "--engine", "ray", "--jobs", "2", "--json")
    with watched() as seen:
        done = dnnmso(*args, cwd=tmp_path, env=seen.environment)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert len(seen.sockets) >= 4
    assert not seen.open_to_others
    document = json.loads(done.stdout)
    assert (document["engine"], document["jobs"], document["ok"]) == ("ray", 2, 4)
    assert pq.read_table(tmp_path / "x.parquet").num_rows == 4


@pytest.mark.parametrize(
    ("address", "message"), [("127.0.0.1:1", "refused"), ("head", "not HOST:PORT")]
)
def test_a_cluster_that_is_not_there_is_refused_at_once(tmp_path, address, message):
    args = ("sweep", "paper", "--seeds", "0:2", "--set", "duration=0.1", "--engine", "ray")
    done = dnnmso(*args, "--address", address, cwd=tmp_path)
    assert done.returncode == 2
    assert f"--address {address}: no Ray there" in done.stderr
    assert message in done.stderr
    assert "HOST:PORT of a cluster" in done.stderr
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_ray_that_is_not_installed_is_named_with_what_to_install(tmp_path):
    hidden = tmp_path / "hidden"
    hidden.mkdir()
    (hidden / "ray.py").write_text("raise ImportError('as if it were not there')")
    path = f"{hidden}:{os.environ.get('PYTHONPATH', '')}"
    environment = {**os.environ, "PYTHONPATH": path}
    args = ("sweep", "paper", "--seeds", "0:2", "--engine", "ray")
    done = dnnmso(*args, cwd=tmp_path, env=environment)
    assert done.returncode == 2
    assert "pip install 'dnnmso_mj[ray]'" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["hidden"]
