"""Row 6 in short, and that its checkers see what is broken."""

from __future__ import annotations

import json
import resource

import pytest
from soak import write_errors
from soak.forked import Told
from soak.proof import prove

from dnnmso_mj.errors import UnloggedRunError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.reading import read_trace
from dnnmso_mj.run import run_logged
from dnnmso_mj.tuning import TuneError
from dnnmso_mj.tuning.study import Study


@pytest.mark.alone
def test_what_cannot_be_written_is_one_error_and_the_run_is_summed_up(tmp_path):
    prove(6, tmp_path)


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bench")
    done = run_logged(load_scenario("paper", ["duration=0.4"]), folder / "whole.mcap")
    return write_errors.Bench(folder, done.log, done.log, done.trace, None)


def told(out="", err="error: /x/place/run.mcap cannot be written: Input/output error", status=2):
    return Told(status, out, err)


@pytest.mark.parametrize(
    ("given", "what"),
    [
        (told(status=0), "status 0"),
        (told(err="Traceback …\nerror: place: Input/output error"), "status 2"),
        (told(err="error: Input/output error"), "names no file"),
        (told(err="error: place cannot be written"), "does not say"),
        (told(out="summary"), "no log is there, and a summary is"),
    ],
)
def test_an_error_that_does_not_say_it_all_is_seen(bench, tmp_path, given, what):
    place = tmp_path / "place"
    place.mkdir()
    with pytest.raises(AssertionError, match=what):
        write_errors.check(bench, "run", given, place / "run.mcap", "Input/output error")


def test_litter_is_seen(bench, tmp_path):
    place = tmp_path / "place"
    place.mkdir()
    (place / ".dnnmso-1.part").touch()
    with pytest.raises(AssertionError, match="left behind"):
        write_errors.check(bench, "run", told(), place / "run.mcap", "Input/output error")


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"status": "ok"}, "ok"),
        ({"reason": "something"}, "something"),
        ({"metrics": {"rmse": 0.5}}, "rmse is not of the ticks in the log"),
    ],
)
def test_a_summary_of_something_else_is_seen(bench, tmp_path, change, what):
    out = tmp_path / "run.mcap"
    out.write_bytes(bench.log.read_bytes()[:-5000])
    summary = {"status": "failed", "reason": f"{out}: why", "metrics": {}} | change
    with pytest.raises(AssertionError, match=what):
        write_errors.check_run(bench, told(json.dumps(summary)), out, as_json=True)


def test_half_a_picture_is_seen(tmp_path):
    (tmp_path / "run.png").write_bytes(b"\x89PNG\r\n")
    with pytest.raises(Exception, match="cannot identify"):
        write_errors.check_whole(tmp_path)


def test_a_run_whose_log_is_taken_away_has_its_metrics_still(tmp_path):
    out = tmp_path / "run.mcap"
    scenario = load_scenario("paper", ["duration=0.4"])

    def remove(_done: int) -> None:
        out.unlink(missing_ok=True)

    with pytest.raises(UnloggedRunError, match="was moved or removed") as failed:
        run_logged(scenario, out, progress=remove)
    run = failed.value.run
    assert (run.info.status, run.ticks) == ("failed", scenario.n_ticks)
    whole = run_logged(scenario, tmp_path / "whole.mcap")
    assert run.info.metrics["rmse"] == whole.info.metrics["rmse"]
    assert read_trace(whole.log).info.status == "ok"


def test_a_study_that_cannot_be_written_is_one_error_that_names_it(tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, before[1]))
    try:
        with pytest.raises(TuneError, match=r"pd\.db: cannot be written: .+--resume goes on"):
            Study(tmp_path / "pd.db", "pd", {}, {}, {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
