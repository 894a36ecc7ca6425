"""A sweep on a Ray cluster: the same tasks, wherever there is a free core."""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Generator, Iterable, Iterator
from contextlib import chdir, contextmanager, nullcontext
from dataclasses import replace
from ipaddress import ip_address
from types import ModuleType
from typing import Any

from dnnmso_mj.errors import MissingExtraError
from dnnmso_mj.interrupts import held_back
from dnnmso_mj.provenance import software_versions
from dnnmso_mj.sources import PACKAGE, sources_digest
from dnnmso_mj.sweep.plan import NUMBERS_DEPEND_ON, SweepError
from dnnmso_mj.sweep.task import Row, Task, failed_row, run_task
from dnnmso_mj.wording import clean

RETRIES = 2  # of a task whose machine or process is lost
AHEAD = 2  # tasks a core in flight, so that no core waits for the driver
REACH_TIMEOUT = 5.0  # s
GATHER_PERIOD = 0.1  # s
LOOK_PERIOD = 5.0  # s between two looks at how many cores the cluster has now


class RayEngine:
    """Runs tasks on a Ray cluster.

    Args:
        jobs: runs at once; None takes every core of the cluster, also those that join it later.
        address: "auto" or HOST:PORT; None starts Ray on this machine alone.

    Raises:
        MissingExtraError: Ray is not installed.
    """

    name = "ray"

    def __init__(self, jobs: int | None = None, address: str | None = None) -> None:
        self._ray = _import_ray()
        self._asked, self._address = jobs, address
        self._looked = 0.0
        self.jobs = jobs or 1

    def rows(self, tasks: Iterable[Task]) -> Generator[Row]:
        """Yield every run's row as its task is finished; closing the generator leaves the cluster.

        A task that is lost with its machine or process is run again elsewhere, up to `RETRIES`
        times; then its runs one by one, and the row of one that is lost again says so.

        Raises:
            SweepError: the cluster cannot be reached, or has other software than this machine.
        """
        with _connected(self._ray, self._address, self._asked):
            yield from self._rows(iter(tasks))

    def _rows(self, tasks: Iterator[Task]) -> Iterator[Row]:
        ray = self._ray
        remote = ray.remote(num_cpus=1, max_retries=RETRIES)(_run_checked)
        versions = _versions()
        pending: dict[Any, Task] = {}
        while True:
            while len(pending) < self._in_flight() and (task := next(tasks, None)) is not None:
                pending[remote.remote(task, versions)] = task
            if not pending:
                return
            # Many at a time: one by one, a thousand cores would keep the driver busy with waiting.
            ready, _ = ray.wait(list(pending), num_returns=len(pending), timeout=GATHER_PERIOD)
            for reference in ready:
                task = pending.pop(reference)
                try:
                    yield from ray.get(reference)
                except ray.exceptions.RayTaskError as error:
                    raise SweepError(str(error.cause)) from error
                except ray.exceptions.RayError as error:
                    if len(task.seeds) == 1:
                        yield failed_row(task.point, task.seeds[0], _first_line(error))
                        continue
                    for seed in task.seeds:
                        single = replace(task, seeds=(seed,))
                        pending[remote.remote(single, versions)] = single

    def _in_flight(self) -> int:
        """How many tasks the cluster shall have now; it may grow and shrink."""
        now = time.monotonic()
        if self._asked is not None:
            return self._asked
        if now - self._looked > LOOK_PERIOD:
            self._looked = now
            self.jobs = max(1, int(self._ray.cluster_resources().get("CPU", 1)))
        return AHEAD * self.jobs


def _run_checked(task: Task, versions: dict[str, str]) -> list[Row]:
    """On a machine of the cluster: run a task, if that can give the same numbers as anywhere."""
    here = _versions()
    if here != versions:
        raise SweepError(
            f"{os.uname().nodename} has {_listing(here)}; "
            f"allowed: what this sweep was started with: {_listing(versions)}"
        )
    return list(run_task(task))


def _versions() -> dict[str, str]:
    versions = software_versions()
    return {name: versions[name] for name in NUMBERS_DEPEND_ON} | {"code": sources_digest()[:12]}


def _listing(versions: dict[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in versions.items())


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return f"its task was lost: {type(error).__name__}: {lines[0] if lines else ''}"


def _import_ray() -> ModuleType:
    # Neither statistics for Ray's makers nor its advice on accelerators belongs in a sweep.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        import ray
    except ImportError as error:
        raise MissingExtraError(
            "--engine ray: Ray is not installed; allowed: --engine local, or "
            "pip install 'dnnmso_mj[ray]'"
        ) from error
    ray_module: ModuleType = ray
    return ray_module


@contextmanager
def _connected(ray: ModuleType, address: str | None, jobs: int | None) -> Iterator[None]:
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    if address is None:
        options |= {"address": "local", "num_cpus": jobs, "include_dashboard": False}
    else:
        options |= {"address": address}
    with _on_loopback(ray) if address is None else nullcontext():
        ours = False  # not one that the caller has started, which Ray then refuses to start again
        try:
            # Broken off while it starts, Ray may end in a segmentation fault.
            with held_back() if address is None else nullcontext():
                _start(ray, address, options)
                ours = True
            if address is None:
                _check_alone(ray.util.get_node_ip_address())
            yield
        finally:
            if ours:
                with held_back():
                    ray.shutdown()


def _start(ray: ModuleType, address: str | None, options: dict[str, Any]) -> None:
    try:
        _check_reachable(address)
        # Ray puts the folder of this moment first where its workers import from: let it be the
        # one that this code came from, not whatever the caller stands in.
        with chdir(PACKAGE.parent):
            ray.init(**options)
    except Exception as error:  # of no kind of its own where its processes start too slowly
        where = "this machine" if address is None else f"--address {clean(address)}"
        start = "allowed: auto or HOST:PORT of a cluster that `ray start --head` has started"
        raise SweepError(f"{where}: no Ray there: {clean(str(error))}; {start}") from error


@contextmanager
def _on_loopback(ray: ModuleType) -> Iterator[None]:
    """Ray that is started inside listens on 127.0.0.1 alone.

    Left to itself it takes the whole network's orders, without a password, and an address that it
    is given it replaces, unless it takes this machine for one that has no clusters. The variable
    is for its processes; for this one it may come too late.
    """
    constants = ray._private.ray_constants
    variable = constants.ENABLE_RAY_CLUSTERS_ENV_VAR
    before = os.environ.get(variable), constants.ENABLE_RAY_CLUSTER
    os.environ[variable], constants.ENABLE_RAY_CLUSTER = "0", False
    try:
        yield
    finally:
        os.environ.pop(variable)
        if before[0] is not None:
            os.environ[variable] = before[0]
        constants.ENABLE_RAY_CLUSTER = before[1]


def _check_alone(host: str) -> None:
    if not ip_address(host).is_loopback:
        raise SweepError(
            f"Ray listens on {host}, where others reach it; allowed: 127.0.0.1. "
            "Use --engine local, or another version of Ray"
        )


def _check_reachable(address: str | None) -> None:
    """Knock first: Ray itself waits for many minutes at a door that nobody opens."""
    if address in {None, "auto"}:
        return
    host, _, port = str(address).rpartition(":")
    if not (host and port.isdecimal()):
        raise ValueError("not HOST:PORT")
    socket.create_connection((host, int(port)), REACH_TIMEOUT).close()
