"""What `from dnnmso_mj import …` gives, and what a trace can be turned into."""

from __future__ import annotations

import ast
import doctest
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import dnnmso_mj
from dnnmso_mj import load_scenario, run_logged, simulate, trace_table
from dnnmso_mj.errors import DnnmsoError, MissingExtraError
from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.trace import StepLayout, Trace

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def trace() -> Trace:
    return simulate(load_scenario("paper", ["duration=0.3", "seed=3"], controller="no_network"))


# --- names ------------------------------------------------------------------------------------


def test_every_name_is_there_and_only_those():
    assert set(dnnmso_mj.__all__) == {*dnnmso_mj._HOMES, "__version__"}
    assert dnnmso_mj.__all__ == sorted(dnnmso_mj.__all__)
    for name in dnnmso_mj.__all__:
        assert getattr(dnnmso_mj, name) is not None
        assert name in dir(dnnmso_mj)
    with pytest.raises(AttributeError, match="no attribute 'simulat'"):
        _ = dnnmso_mj.simulat


def test_type_checkers_see_the_names_where_they_are():
    tree = ast.parse(Path(dnnmso_mj.__file__).read_text())
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    seen = {name.name: node.module for node in imports for name in node.names}
    expected = {name: f"dnnmso_mj.{home}" for name, home in dnnmso_mj._HOMES.items()}
    assert expected.items() <= seen.items()


def test_no_module_hides_a_name_that_it_is_called_like():
    modules = {path.stem for path in Path(dnnmso_mj.__file__).parent.iterdir()}
    assert not modules & set(dnnmso_mj.__all__)


def test_the_package_alone_imports_next_to_nothing():
    code = "import sys, dnnmso_mj; dir(dnnmso_mj); print(*sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    ours = {name for name in said.stdout.split() if name.startswith("dnnmso_mj")}
    assert ours == {"dnnmso_mj"}
    assert not {"numpy", "importlib.metadata"} & set(said.stdout.split())


@pytest.mark.parametrize("module", ["dnnmso_mj", "dnnmso_mj.trace"])
def test_the_examples_in_docstrings_do_as_they_say(module):
    done = doctest.testmod(sys.modules[module])
    assert done.attempted > 2
    assert done.failed == 0


# --- a trace ----------------------------------------------------------------------------------


def test_a_table_has_one_column_a_number_with_its_unit(trace):
    table = trace.table()
    assert table.num_rows == len(trace) == 300
    for name in trace:
        values = trace[name]
        if values.ndim == 1:
            assert np.array_equal(table[name].to_numpy(), values, equal_nan=True)
        for k, column in enumerate(values.T if values.ndim == 2 else ()):
            assert np.array_equal(table[f"{name}{k + 1}"].to_numpy(), column, equal_nan=True)
    widths = StepLayout(2, 0).widths
    assert table.num_columns == sum(widths.values())
    units = {field.name: field.metadata[b"unit"].decode() for field in table.schema}
    assert (units["q2"], units["f_hat2"], units["f_hat3"]) == ("rad", "rad/s", "rad/s²")
    assert load_scenario("paper").dt == 0.001
    about = table.schema.metadata
    assert type(trace.scenario).model_validate_json(about[b"scenario"]) == trace.scenario
    assert about[b"seed"] == b"3"


def test_units_are_those_of_the_page_on_logs():
    page = (ROOT / "docs" / "logs.md").read_text()
    told = {}
    for names, units in re.findall(r"^\| ((?:`\w+`(?:, )?)+) \| [^|]+ \| ([^|]+) \|", page, re.M):
        fields, each = re.findall(r"\w+", names), units.strip().split(", ")
        told |= dict(zip(fields, each if len(each) > 1 else each * len(fields), strict=False))
    assert set(StepLayout(2, 3).widths) <= set(told)
    for name, unit in trace_table.UNITS.items():
        assert told[name].replace("–", "1") == unit, name


def test_a_data_frame_has_the_time_as_its_index(trace):
    frame = trace.to_pandas()
    assert frame.index.name == "t"
    assert np.array_equal(frame["tau2"], trace["tau"][:, 1])
    assert frame["saturated"].dtype == bool
    assert list(frame.columns) == trace.table().column_names[1:]


def test_without_pandas_it_says_what_to_install(trace, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtraError, match=r"needs pandas, .*: pip install pandas"):
        trace.to_pandas()


def test_metrics_are_computed_when_asked_for(trace):
    assert trace.metrics == compute_metrics(trace)
    assert trace.metrics is trace.metrics


def test_a_logged_run_s_metrics_are_those_of_its_trace(tmp_path):
    logged = run_logged(load_scenario("paper", ["duration=0.1"], controller="pd"), tmp_path / "a")
    assert logged.trace.metrics == logged.trace.info.metrics


def test_a_column_that_is_not_there_is_refused_with_those_that_are(trace):
    with pytest.raises(KeyError, match="'qq'; a trace has t, q, qd, q_meas"):
        trace["qq"]


def test_it_shows_itself_in_a_line_and_as_a_table(trace):
    assert re.fullmatch(
        r"<Trace of paper, seed 3, ok: 300 ticks, 0\.3 s, rmse [\d.]+ rad, rmse_steady [\d.]+ rad, "
        r"tau_peak [\d.]+ N·m>",
        repr(trace),
    )
    assert "<th>ticks</th><td>300</td>" in trace._repr_html_()


def test_one_call_draws_angles_errors_and_torques(trace):
    figure = trace.plot()
    assert isinstance(figure, Figure)
    angles, error, torques = figure.axes
    assert [line.get_label() for line in angles.get_lines()] == [
        "joint 1",
        "joint 2",
        "reference",
        "reference",
    ]
    assert np.allclose(torques.get_lines()[1].get_ydata()[-1], trace["tau"][-1, 1])
    assert (error.get_yscale(), error.get_ylabel()) == ("log", "|e| (rad)")
    assert figure._repr_png_().startswith(b"\x89PNG")


def test_a_run_without_a_tick_is_not_drawn(trace):
    empty = Trace({name: trace[name][:0] for name in trace}, trace.scenario, trace.info)
    with pytest.raises(DnnmsoError, match="nothing to draw"):
        empty.plot()
    assert "0 ticks" in repr(empty)
