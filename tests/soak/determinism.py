"""Row 10: the same scenario gives the same bytes, however, wherever and whenever it is run."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dnnmso_mj import load_scenario, run_logged, simulate
from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.sweep.plan import plan_sweep
from dnnmso_mj.sweep.run import Engine, make_engine, run_sweep
from dnnmso_mj.viewer.live import LiveView, connected
from soak import golden
from soak.sameness import MONITORS, columns_digest, digest, log_digest, untimed
from soak.tally import Form, Tally
from soak.trials import Trial, answers, elsewhere, trials

# Surroundings that have changed results of others: threads of libraries, languages, hashes, places,
# and memory that is full of something before it is used.
SURROUNDINGS: dict[str, Mapping[str, str]] = {
    "dirty memory": {"MALLOC_PERTURB_": "165", "PYTHONMALLOC": "debug"},
    "one thread": {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
    "eight threads": {"OMP_NUM_THREADS": "8", "OPENBLAS_NUM_THREADS": "8"},
    "Turkish": {"LANG": "tr_TR.UTF-8", "LC_ALL": "tr_TR.UTF-8", "TZ": "Asia/Kathmandu"},
    "no language": {"LANG": "C", "LC_ALL": "C", "PYTHONUTF8": "0"},
    "hashes": {"PYTHONHASHSEED": "4294967295"},
    "no assertions": {"PYTHONOPTIMIZE": "2"},
}
NOBODY = "rerun+http://127.0.0.1:9/proxy"  # where no viewer is


class Known(NamedTuple):
    """Trials, and the digest that each gave when it first ran."""

    trials: Mapping[str, Trial]
    digests: Mapping[str, str]


def run(form: Form, tally: Tally, folder: Path) -> None:
    """All trials here first; then the same ones in every other way."""
    asked = trials(folder, form.seed, form.pick(0.2, 1.0))
    known = Known(asked, {name: trial.digest() for name, trial in asked.items()})
    tally.figure("scenarios", len(asked))
    repeats(form, tally, known)
    in_another_order(form, tally, known)
    in_threads_and_forks(form, tally, known)
    logs(form, tally, folder, known)
    processes(form, tally, folder, known)
    cold(form, tally, folder, known)
    sweeps(form, tally, folder)
    golden_hashes(form, tally)


def compare(tally: Tally, what: str, found: Mapping[str, str], known: Known) -> None:
    """Count each digest that is as expected, and name the others."""
    for name, value in found.items():
        expected = known.digests[name]
        if value == expected:
            tally.survive()
        else:
            tally.lose(f"{name}, {what}: {value[:12]}, and not {expected[:12]}")


def repeats(form: Form, tally: Tally, known: Known) -> None:
    """Again and again in this process, from anew."""
    count = form.pick(5, 100)
    tally.figure("repeats in one process", count)
    for k in range(count):
        found = {name: trial.digest() for name, trial in known.trials.items()}
        compare(tally, f"repeat {k}", found, known)


def in_another_order(form: Form, tally: Tally, known: Known) -> None:
    """After other scenarios, in a random order, and between runs of other seeds."""
    rng = np.random.default_rng(form.seed)
    for _ in range(form.pick(1, 10)):
        for name in rng.permutation(list(known.trials)).tolist():
            other = load_scenario("paper", [f"seed={rng.integers(1000)}", "duration=0.02"])
            simulate(other, watch=bool(rng.integers(2)))
            compare(tally, "in another order", {name: known.trials[name].digest()}, known)


def in_threads_and_forks(form: Form, tally: Tally, known: Known) -> None:
    """All at once, each in a thread of its own; then in a forked process."""
    for _ in range(form.pick(1, 5)):
        found: dict[str, str] = {}

        def work(name: str, into: dict[str, str] = found) -> None:
            into[name] = known.trials[name].digest()

        threads = [threading.Thread(target=work, args=(name,)) for name in known.trials]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        for name in known.trials:
            compare(tally, "in a thread", {name: found.get(name, "no run")}, known)
    for name, trial in known.trials.items():
        compare(tally, "after a fork", {name: forked(trial.digest)}, known)


def forked(work: Callable[[], str]) -> str:
    """What a forked process says."""
    out, into = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.write(into, work().encode())
        finally:
            os._exit(0)
    os.close(into)
    with os.fdopen(out) as pipe:
        said = pipe.read()
    os.waitpid(child, 0)
    return said or "no run"


def logs(form: Form, tally: Tally, folder: Path, known: Known) -> None:
    """Logged twice, once with a live view; and without monitors."""
    for name, trial in known.trials.items():
        scenario, files = trial.scenario(), list[Path]()
        for view in (False, True):
            with live(folder / "live.rrd", form.long) if view else no_view() as watcher:
                out = folder / f"{name}-{view}.mcap"
                done = run_logged(scenario, out, live=watcher)
            compare(tally, f"logged, live view: {view}", {name: digest(done.trace)}, known)
            files.append(done.log)
        with tally.case(f"{name}: two logs, byte for byte but for the wall clock"):
            assert log_digest(files[0]) == log_digest(files[1])
        with tally.case(f"{name}: without monitors"):
            bare, whole = (
                columns_digest(simulate(scenario, watch=w), MONITORS) for w in (False, True)
            )
            assert bare == whole


@contextmanager
def no_view() -> Iterator[None]:
    """Nobody looks on."""
    yield None


@contextmanager
def live(out: Path, viewer: bool) -> Iterator[LiveView]:
    """A live view into a Rerun program that keeps all in a file; or into nothing."""
    from dnnmso_mj.viewer.process import data_address, free_port, listens, rerun

    if not viewer:
        with connected(NOBODY) as view:
            yield view
        return
    port = free_port()
    with rerun("--port", str(port), "--save", str(out)) as process:
        process.wait_until(lambda: listens(port), "ready")
        with connected(data_address(port)) as view:
            yield view


def processes(form: Form, tally: Tally, folder: Path, known: Known) -> None:
    """In fresh processes, two at once, in other surroundings and elsewhere."""
    names = list(known.trials)
    given = [known.trials[name] for name in names]
    places = {"elsewhere": partial(elsewhere, given, cwd=folder)}
    for what, env in list(SURROUNDINGS.items())[: form.pick(1, len(SURROUNDINGS))]:
        places[what] = partial(elsewhere, given, env=env)
    for k in range(form.pick(0, 6)):
        places[f"process {k}"] = partial(elsewhere, given)
    started = list(places.items())
    for pair in (started[k : k + 2] for k in range(0, len(started), 2)):
        for what, process in [(what, start()) for what, start in pair]:
            with tally.case(f"a process ({what})"):
                found = dict(zip(names, answers(process), strict=True))
                compare(tally, f"a process ({what})", found, known)
    tally.figure("processes, two at once", len(places))


def cold(form: Form, tally: Tally, folder: Path, known: Known) -> None:
    """With nothing compiled: by the process that compiles, then by one that finds it done."""
    names = form.pick(["pd, dt 0.5 ms"], ["pd, dt 0.5 ms", "paper", "policy"])
    given = [known.trials[name] for name in names]
    cache = folder / "cold"
    # In the long form two processes compile the same at once.
    for what, at_once in (("cold", form.pick(1, 2)), ("warm", 1)):
        for process in [
            elsewhere(given, env={"NUMBA_CACHE_DIR": str(cache)}) for _ in range(at_once)
        ]:
            with tally.case(f"compiled code, {what}"):
                found = dict(zip(names, answers(process), strict=True))
                compare(tally, f"compiled code, {what}", found, known)


def sweeps(form: Form, tally: Tally, folder: Path) -> None:
    """Rows of sweeps with other numbers of workers, against single runs, bit for bit."""
    seeds = range(form.seed, form.seed + form.pick(4, 16))
    sets = [f"duration={form.pick(0.2, 1.0)}"]
    single = {}
    for seed in seeds:
        scenario = load_scenario("paper", [*sets, f"seed={seed}"])
        single[seed] = untimed(simulate(scenario).metrics)
        done = run_logged(scenario, folder / f"single-{seed}.mcap")
        with tally.case(f"seed {seed}: a logged run and one in memory"):
            assert untimed(done.info.metrics) == single[seed]
    engines: dict[str, Callable[[], Engine]] = {
        f"{jobs} workers": partial(make_engine, "local", jobs)
        for jobs in form.pick((2,), (1, 2, 8))
    }
    if form.long:
        engines["Ray"] = partial(make_engine, "ray", 2)
    for what, make in engines.items():
        try:
            plan = plan_sweep("paper", seeds, sets)
            table = run_sweep(plan, folder / f"{what}.parquet", make()).table
        except DnnmsoError as error:
            if what != "Ray":
                raise
            tally.leave_out("a sweep on Ray", str(error))
            continue
        for row in table.to_pylist():
            with tally.case(f"a row of {what}, seed {row['seed']}"):
                assert {name: row[name] for name in single[row["seed"]]} == single[row["seed"]]


def golden_hashes(form: Form, tally: Tally) -> None:
    """Against the hashes that are kept for this machine."""
    kept = golden.known().get(golden.key())
    tally.figure("golden hashes", f"of {golden.key()}" if kept else golden.missing())
    if kept is None:
        if form.long:
            tally.leave_out("golden hashes", golden.missing())
        return
    found = golden.measured()
    for wrong in golden.differing(kept, found):
        tally.lose(f"golden hash of {wrong}")
    tally.survive(sum(kept.get(name) == value for name, value in found.items()))
