"""Sweeps: the same table whatever the workers, the order and the interruptions; nothing lost."""

from __future__ import annotations

import itertools
import json
import os
import random
import resource
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from sweep_samples import (
    DEADLY_SEED,
    SMALL_GRID,
    SMALL_SETS,
    Deadly,
    DeadlyOnce,
    Parent,
    foreign_modules,
    rows_in,
    small_plan,
    untimed,
    wait_until,
    with_scenario,
)

from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.run import run_logged
from dnnmso_mj.simulation import simulate
from dnnmso_mj.sources import sources_digest
from dnnmso_mj.sweep.journal import Journal, journal_path
from dnnmso_mj.sweep.local import LocalEngine
from dnnmso_mj.sweep.plan import Plan, plan_sweep
from dnnmso_mj.sweep.run import run_sweep
from dnnmso_mj.sweep.summary import summarise
from dnnmso_mj.sweep.table import (
    METADATA_KEY,
    METRIC_TYPES,
    ROW_SCHEMA,
    TIMING,
    finished_table,
    read_table,
    write_table,
)
from dnnmso_mj.sweep.task import Task, failed_row, run_task


@pytest.fixture(scope="module")
def plan() -> Plan:
    return small_plan()


@pytest.fixture(scope="module")
def serial(plan, tmp_path_factory) -> pa.Table:
    """The table that one worker makes."""
    out = tmp_path_factory.mktemp("serial") / "one.parquet"
    return run_sweep(plan, out, LocalEngine(1)).table


def is_there(process: int) -> bool:
    """Whether it runs; a process that has ended and that nobody has waited for does not."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


class Shuffled(LocalEngine):
    """Two workers that get their runs one by one in an order of their own."""

    def rows(self, tasks):
        singles = [replace(task, seeds=(seed,)) for task in tasks for seed in task.seeds]
        random.Random(4).shuffle(singles)
        return super().rows(singles)


class InOneTask(LocalEngine):
    """A worker that gets all runs at once."""

    def rows(self, tasks):
        first, *others = tasks
        seeds = (first.seeds, *(task.seeds for task in others))
        return super().rows([replace(first, seeds=tuple(itertools.chain(*seeds)))])


class InProcess:
    """Runs everything in this process."""

    name, jobs = "in process", 1

    def rows(self, tasks):
        for task in tasks:
            yield from run_task(task)


class Stops(InProcess):
    """Ctrl-C after some rows."""

    def __init__(self, after: int) -> None:
        self.after = after

    def rows(self, tasks):
        with closing(super().rows(tasks)) as rows:
            for _ in range(self.after):
                yield next(rows)
        raise KeyboardInterrupt


class Forbidden(InProcess):
    """An engine that nothing may be asked of."""

    def rows(self, tasks):
        raise AssertionError("there was nothing left to run")


def interrupt(plan: Plan, out: Path, after: int = 7, **options) -> None:
    with pytest.raises(KeyboardInterrupt):
        run_sweep(plan, out, Stops(after), **options)
    assert rows_in(journal_path(out)) == after
    assert not out.exists()


# The numbers


@pytest.mark.parametrize("engine", [LocalEngine(2), Shuffled(2)], ids=["two workers", "shuffled"])
def test_the_table_depends_on_neither_workers_nor_order(plan, serial, tmp_path, engine):
    result = run_sweep(plan, tmp_path / "x.parquet", engine)
    assert untimed(result.table).equals(untimed(serial))
    assert untimed(pq.read_table(result.out)).equals(untimed(serial))
    assert not journal_path(result.out).exists()


def test_rows_are_those_of_single_logged_runs(plan, serial, tmp_path):
    for seed, feedback in ((0, "stable"), (6, "stable"), (2, "as_printed")):
        sets = [*SMALL_SETS, f"controller.observer.feedback={feedback}", f"seed={seed}"]
        run = run_logged(load_scenario("paper", sets), tmp_path / f"{feedback}{seed}.mcap").trace
        index = seed + 20 * (feedback == "as_printed")
        row = serial.slice(index, 1).to_pylist()[0]
        assert row["seed"] == seed
        assert row["controller.observer.feedback"] == feedback
        assert (row["status"], row["reason"]) == (run.info.status, run.info.reason)
        for name, value in run.info.metrics.items():
            if name not in TIMING:
                assert row[name] == value, name


def test_rows_stand_by_grid_point_then_seed(plan, serial):
    found = list(
        zip(
            serial["controller.observer.feedback"].to_pylist(),
            serial["plant.gravity"].to_pylist(),
            serial["seed"].to_pylist(),
            strict=True,
        )
    )
    points = [(f, g) for f in ("stable", "as_printed") for g in (9.81, 1.62)]
    assert found == [(*point, seed) for point in points for seed in range(10)]


def test_columns_are_seed_parameters_status_and_the_metrics_by_their_names(plan, serial):
    trace = simulate(plan.points[0].scenario)
    metrics = compute_metrics(trace)
    assert list(METRIC_TYPES) == list(metrics)
    kinds = {float: pa.float64(), int: pa.int64(), bool: pa.bool_()}
    for name, value in metrics.items():
        assert value is None or METRIC_TYPES[name] == kinds[type(value)], name
    parameters = ["duration", "controller.observer.K2", "controller.observer.feedback"]
    parameters += ["plant.gravity"]
    ends = ["ticks", "wall_s"]
    assert serial.schema.names == ["seed", *parameters, "status", "reason", *metrics, *ends]
    types = [serial.schema.field(name).type for name in parameters]
    assert types == [pa.float64(), pa.float64(), pa.string(), pa.float64()]


def test_a_row_survives_the_journal_to_the_last_bit(plan, tmp_path):
    rng = np.random.default_rng(5)
    one = replace(plan, points=plan.points[:1], seeds=tuple(range(2000)))
    bits = rng.integers(0, 2**63, 2000).view(np.float64)
    values = np.where(np.isfinite(bits), bits, 5e-324)
    with Journal(tmp_path / "x.parquet", one) as journal:
        for seed, value in enumerate(values.tolist()):
            journal.append(failed_row(0, seed, 'naïve: \\ " 1') | {"rmse": value, "tau_peak": None})
        table = journal.rows()
    assert table["rmse"].to_numpy().tobytes() == values.tobytes()
    assert table["tau_peak"].null_count == 2000
    assert set(table["reason"].to_pylist()) == {'naïve: \\ " 1'}


def test_parameters_of_mixed_kinds_are_json_text(plan):
    def column(values):
        points = [replace(plan.points[0], parameters={"p": value}) for value in values]
        some = replace(plan, points=tuple(points), seeds=(0,))
        rows = [failed_row(k, 0, "") for k in range(len(values))]
        full = pa.Table.from_pylist(rows, schema=ROW_SCHEMA)
        return finished_table(full, some, {})["p"]

    assert column([1, 2.5]).type == pa.float64()
    assert column([[1, 2], [3]]).type == pa.list_(pa.int64())
    assert column([[1, 2], [2.5]]).type == pa.list_(pa.float64())
    assert column([[1, 2], [True]]).to_pylist() == ["[1, 2]", "[true]"]
    assert column([None, 2.0]).to_pylist() == [None, 2.0]
    assert column([1, "two"]).to_pylist() == ["1", '"two"']
    assert column([True, 1]).to_pylist() == ["true", "1"]
    assert column([{"kind": "constant"}]).to_pylist() == ['{"kind": "constant"}']


def test_the_file_says_how_to_make_it_again(plan, tmp_path):
    out = tmp_path / "x.parquet"
    run_sweep(replace(plan, seeds=(0, 1, 5)), out, InProcess(), command="dnnmso sweep …")
    _, provenance = read_table(out)
    assert provenance["command"] == "dnnmso sweep …"
    assert provenance["seeds"] == "0:2,5"
    assert provenance["engine"] == "in process"
    assert provenance["software"]["mujoco"]
    definition = provenance["definition"]
    assert definition["points"][1]["scenario"]["plant"]["gravity"] == 1.62
    assert definition["models"]["two_link"].startswith("<")
    assert set(definition) == {"points", "models", "versions", "git_commit", "source_sha256"}
    assert METADATA_KEY in pq.read_schema(out).metadata


# Runs that end badly


def test_diverged_rows_are_rows_and_have_no_say_in_the_statistics(plan, serial):
    stable, _, printed, _ = summarise(serial, plan)
    assert (stable.ok, stable.count("diverged"), stable.failures) == (10, 0, [])
    assert stable.metrics["rmse"].n == 10
    assert (printed.runs, printed.ok, printed.count("diverged")) == (10, 0, 10)
    assert printed.metrics["rmse"].n == 0
    assert [failure.seed for failure in printed.failures] == list(range(10))
    assert all(" at t = " in failure.reason for failure in printed.failures)
    last = serial.slice(20, 10)
    assert last["diverged"].to_pylist() == [True] * 10
    assert max(last["ticks"].to_pylist()) < 120


MASSLESS = "<mujoco><worldbody><body><joint/></body></worldbody></mujoco>"


def test_a_run_that_raises_is_a_row_and_the_others_go_on(plan):
    point = plan.points[0]
    tasks = [
        Task(0, point.scenario, Mjcf(MASSLESS), (0,)),
        Task(1, point.scenario, point.mjcf, (1,)),
    ]
    rows = list(LocalEngine(1).rows(tasks))
    assert [(row["point"], row["status"]) for row in rows] == [(0, "failed"), (1, "ok")]
    assert rows[0]["reason"].startswith("ScenarioError: plant.masses and plant.lengths: the model")
    assert rows[0]["ticks"] == 0


@pytest.fixture
def importable(monkeypatch):
    """Worker processes find this folder's modules."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=":")


def test_a_run_that_kills_its_process_is_a_row_and_the_others_go_on(
    plan, serial, tmp_path, importable
):
    deadly = with_scenario(replace(plan, points=plan.points[:1]), Deadly)
    table = run_sweep(deadly, tmp_path / "x.parquet", InOneTask(1)).table
    rows = table.to_pylist()
    assert [row["seed"] for row in rows if row["status"] == "failed"] == [DEADLY_SEED]
    assert rows[DEADLY_SEED]["reason"] == "its process died twice: SIGSEGV"
    assert rows[DEADLY_SEED]["rmse"] is None
    others = [seed for seed in range(10) if seed != DEADLY_SEED]
    assert untimed(table).take(others).equals(untimed(serial).take(others))


def test_a_run_whose_process_was_killed_once_is_run_again(plan, serial, tmp_path, importable):
    memory = str(tmp_path / "killed")
    once = with_scenario(replace(plan, points=plan.points[:1]), DeadlyOnce, description=memory)
    table = run_sweep(once, tmp_path / "x.parquet", InOneTask(1)).table
    assert Path(memory).exists()
    assert untimed(table).equals(untimed(serial).slice(0, 10))


def test_a_worker_that_is_ended_takes_along_what_it_has_started(plan, tmp_path, importable):
    known = tmp_path / "process"
    point = with_scenario(plan, Parent, description=str(known)).points[0]
    rows = LocalEngine(1).rows([Task(0, point.scenario, point.mjcf, (0, 1))])
    assert next(rows)["status"] == "ok"
    process = int(known.read_text())
    assert is_there(process)
    rows.close()
    wait_until(lambda: not is_there(process))


def test_workers_that_cannot_start_are_an_error_not_an_endless_loop(plan, tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text("import os; os._exit(7)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    with pytest.raises(DnnmsoError, match="cannot start: exit status 7"):
        run_sweep(plan, tmp_path / "x.parquet", LocalEngine(2))
    left = {path.name for path in tmp_path.iterdir()} - {"__pycache__"}
    assert left == {"sitecustomize.py"}


def test_too_many_workers_are_an_error_that_names_jobs(plan, tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (len(os.listdir("/proc/self/fd")) + 8, hard))
    try:
        with pytest.raises(DnnmsoError, match=r"--jobs: worker .* Too many open files; allowed"):
            run_sweep(plan, tmp_path / "x.parquet", LocalEngine(50))
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert list(tmp_path.iterdir()) == []


def test_workers_run_the_code_that_planned_wherever_they_are_started(
    plan, serial, tmp_path, monkeypatch
):
    foreign_modules(tmp_path)
    monkeypatch.chdir(tmp_path)
    table = run_sweep(plan, tmp_path / "x.parquet", LocalEngine(2)).table
    assert untimed(table).equals(untimed(serial))


def test_a_table_without_every_run_is_not_written(plan, tmp_path):
    class LosesOne(InProcess):
        def rows(self, tasks):
            rows = super().rows(tasks)
            next(rows)
            yield from rows

    out = tmp_path / "x.parquet"
    with pytest.raises(DnnmsoError, match="39 rows of 39 runs; allowed: 40"):
        run_sweep(plan, out, LosesOne())
    assert not out.exists()
    assert run_sweep(plan, out, InProcess(), resume=True).kept == 39


# Going on


def test_an_interrupted_sweep_goes_on_to_the_same_table(plan, serial, tmp_path):
    out = tmp_path / "x.parquet"
    interrupt(plan, out)
    result = run_sweep(plan, out, LocalEngine(2), resume=True)
    assert result.kept == 7
    assert untimed(result.table).equals(untimed(serial))


def test_interrupted_twice_and_torn_in_the_last_row_it_still_goes_on(plan, serial, tmp_path):
    out = tmp_path / "x.parquet"
    interrupt(plan, out, after=5)
    with pytest.raises(KeyboardInterrupt):
        run_sweep(plan, out, Stops(6), resume=True)
    with journal_path(out).open("ab") as stream:
        stream.write(b'{"point": 3, "seed": 9, "status": "ok", "rea')
    result = run_sweep(plan, out, InProcess(), resume=True)
    assert result.kept == 11
    assert untimed(result.table).equals(untimed(serial))


def test_resume_where_nothing_is_starts(plan, serial, tmp_path):
    result = run_sweep(plan, tmp_path / "new" / "x.parquet", InProcess(), resume=True)
    assert untimed(result.table).equals(untimed(serial))


def test_resume_of_a_finished_table_runs_nothing(plan, serial, tmp_path):
    out = tmp_path / "x.parquet"
    run_sweep(plan, out, InProcess())
    result = run_sweep(plan, out, Forbidden(), resume=True)
    assert (result.kept, result.ticks) == (40, 0)
    assert untimed(result.table).equals(untimed(serial))


def test_a_finished_table_takes_more_seeds(plan, serial, tmp_path):
    out = tmp_path / "x.parquet"
    run_sweep(replace(plan, seeds=(1, 4, 5)), out, InProcess())
    result = run_sweep(plan, out, InProcess(), resume=True)
    assert result.kept == 12
    assert untimed(result.table).equals(untimed(serial))


def test_resume_names_what_differs_and_leaves_all_as_it_is(plan, tmp_path):
    out = tmp_path / "x.parquet"
    interrupt(plan, out)
    before = journal_path(out).read_bytes()
    other = plan_sweep("paper", range(10), ["duration=0.2", SMALL_SETS[1]], SMALL_GRID)
    with pytest.raises(DnnmsoError) as refusal:
        run_sweep(other, out, resume=True)
    assert "points.0.scenario.duration: 0.12; now: 0.2" in str(refusal.value)
    fewer = replace(plan, points=plan.points[:3])
    with pytest.raises(DnnmsoError, match="points: 4 entries; now: 3"):
        run_sweep(fewer, out, resume=True)
    assert journal_path(out).read_bytes() == before


def test_resume_refuses_other_software(plan, tmp_path):
    out = tmp_path / "x.parquet"
    interrupt(plan, out)
    first, *rows = journal_path(out).read_text().splitlines(keepends=True)
    definition = json.loads(first)
    definition["versions"]["mujoco"] = "3.0.0"
    journal_path(out).write_text(json.dumps(definition) + "\n" + "".join(rows))
    with pytest.raises(DnnmsoError, match=r'versions\.mujoco: "3\.0\.0"; now: '):
        run_sweep(plan, out, resume=True)


def test_resume_refuses_other_code_of_the_same_version(plan, tmp_path):
    out = tmp_path / "x.parquet"
    interrupt(plan, out)
    now = sources_digest()
    journal_path(out).write_text(journal_path(out).read_text().replace(now, now[::-1]))
    with pytest.raises(DnnmsoError, match="source_sha256: "):
        run_sweep(plan, out, resume=True)


def test_resume_refuses_to_forget_seeds(plan, tmp_path):
    out = tmp_path / "x.parquet"
    run_sweep(plan, out, InProcess())
    with pytest.raises(DnnmsoError, match="seeds that are not asked for: 5:10"):
        run_sweep(replace(plan, seeds=(0, 1, 2, 3, 4)), out, resume=True)
    assert len(pq.read_table(out)) == 40


def test_a_damaged_journal_is_refused(plan, tmp_path):
    out = tmp_path / "x.parquet"
    interrupt(plan, out)
    text = journal_path(out).read_text()
    journal_path(out).write_text(text.replace('"seed": 2', '"seed" 2'))
    with pytest.raises(DnnmsoError, match=r"damaged: .*--force starts anew"):
        run_sweep(plan, out, resume=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({}, "point 0 has two rows of seed 2"),
        ({"point": -1}, "a row of point -1; allowed: 0 to 3"),
        ({"point": 4}, "a row of point 4; allowed: 0 to 3"),
    ],
)
def test_a_journal_with_a_row_that_cannot_be_is_refused(plan, tmp_path, change, message):
    out = tmp_path / "x.parquet"
    interrupt(plan, out)
    with journal_path(out).open("a") as stream:
        stream.write(json.dumps(failed_row(0, 2, "for the test") | change) + "\n")
    with pytest.raises(DnnmsoError) as refusal:
        run_sweep(plan, out, resume=True)
    assert f"damaged: {message}; --force starts anew" in str(refusal.value)
    assert run_sweep(plan, out, InProcess(), force=True).kept == 0


# Who may write


def foreign(path: Path, kind: str) -> None:
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "parquet":
        pq.write_table(pa.table({"seed": [1, 2]}), path)
    else:
        path.write_text("name: mine\n")


@pytest.mark.parametrize("options", [{"force": True}, {"resume": True}, {}], ids=str)
@pytest.mark.parametrize("kind", ["text", "parquet", "fifo"])
@pytest.mark.parametrize("place", [Path, journal_path], ids=["table", "journal"])
def test_no_file_but_a_sweeps_own_is_written_over(plan, tmp_path, place, kind, options):
    out = tmp_path / "x.parquet"
    foreign(place(out), kind)
    before = os.stat(place(out))
    with pytest.raises(DnnmsoError, match=r"exists and is not a .*; allowed: another --out"):
        run_sweep(plan, out, Forbidden(), **options)
    after = os.stat(place(out))
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    assert list(tmp_path.iterdir()) == [place(out)]


def test_ctrl_c_while_the_table_is_written_leaves_no_part_of_it(tmp_path):
    class Interrupted:
        @property
        def schema(self):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_table(Interrupted(), tmp_path / "x.parquet")
    assert list(tmp_path.iterdir()) == []


def test_a_finished_table_is_replaced_only_by_force(plan, serial, tmp_path):
    out = tmp_path / "x.parquet"
    run_sweep(replace(plan, seeds=(3,)), out, InProcess())
    before = out.read_bytes()
    with pytest.raises(DnnmsoError, match=r"exists; allowed: --resume .* --force"):
        run_sweep(plan, out)
    assert out.read_bytes() == before
    assert untimed(run_sweep(plan, out, InProcess(), force=True).table).equals(untimed(serial))


def test_an_unfinished_sweep_is_replaced_only_by_force(plan, tmp_path):
    out = tmp_path / "x.parquet"
    interrupt(plan, out)
    before = journal_path(out).read_bytes()
    with pytest.raises(DnnmsoError, match="an unfinished sweep of 7 runs; allowed: --resume"):
        run_sweep(plan, out)
    assert journal_path(out).read_bytes() == before
    assert run_sweep(plan, out, InProcess(), force=True).kept == 0


def test_an_old_table_stays_until_the_new_one_is_whole(plan, tmp_path):
    out = tmp_path / "x.parquet"
    run_sweep(replace(plan, seeds=(3,)), out, InProcess())
    before = out.read_bytes()
    with pytest.raises(KeyboardInterrupt):
        run_sweep(plan, out, Stops(5), force=True)
    assert out.read_bytes() == before
    assert run_sweep(plan, out, InProcess(), resume=True).kept == 5


def test_two_sweeps_do_not_write_one_table(plan, tmp_path):
    out = tmp_path / "x.parquet"
    with Journal(out, plan) as journal:
        journal.append(failed_row(0, 0, "for the test"))
        for options in ({}, {"resume": True}, {"force": True}):
            with pytest.raises(DnnmsoError, match="another sweep is writing it now"):
                run_sweep(plan, out, **options)
    assert rows_in(journal_path(out)) == 1


def test_a_sweep_that_did_nothing_leaves_nothing(plan, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run_sweep(plan, tmp_path / "x.parquet", Stops(0))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("out", [".", "/proc/no/x.parquet"])
def test_an_out_that_cannot_be_written_is_refused(plan, tmp_path, monkeypatch, out):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DnnmsoError, match=r"allowed|cannot be written"):
        run_sweep(plan, Path(out), Forbidden(), force=True)
    assert list(tmp_path.iterdir()) == []


def test_a_task_yields_each_row_as_it_is_finished(plan):
    point = plan.points[0]
    rows = run_task(Task(0, point.scenario, point.mjcf, (8, 2)))
    assert next(rows)["seed"] == 8
    assert next(rows)["seed"] == 2
