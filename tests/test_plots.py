"""Figures hold what the trace holds, and files appear whole or not at all."""

from __future__ import annotations

import gc
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from PIL import Image
from test_recording import full_disk
from trace_samples import trace_with

from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.figures.drawing import envelope, log_line, panels
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.plots import comparison_figures, run_figures, save_comparison, save_figures
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.simulation import simulate
from dnnmso_mj.trace import StepLayout, Trace

pytestmark = [
    pytest.mark.filterwarnings("error"),
    # What other tests have left behind, which may be collected here.
    pytest.mark.filterwarnings("default::pytest.PytestUnraisableExceptionWarning"),
]


def trace_of(
    n_ticks: int = 400,
    n_joints: int = 2,
    n_layers: int = 4,
    status: str = "ok",
    seed: int = 0,
    parts: dict[str, Any] | None = None,
    **columns: Any,
) -> Trace:
    """A trace of positive noise on a true clock, but for the columns given (broadcast)."""
    layout = StepLayout(n_joints, n_layers)
    rows = np.random.default_rng(seed).uniform(0.1, 1.0, size=(n_ticks, layout.width))
    columns = {"saturated": 0.0} | columns
    return trace_with(rows, layout, columns, status=status, seed=seed, parts=parts)


@pytest.fixture(scope="module")
def trace() -> Trace:
    return trace_of()


@pytest.fixture(scope="module")
def figures(trace: Trace) -> dict[str, Figure]:
    return run_figures(trace)


def panel(figure: Figure, title: str) -> Axes:
    (found,) = (axes for axes in figure.axes if axes.get_title(loc="left") == title)
    return found


def line(axes: Axes, label: str) -> Line2D:
    (found,) = (line for line in axes.get_lines() if line.get_label() == label)
    return found


def same(drawn: Line2D, t: np.ndarray, values: np.ndarray) -> bool:
    return np.array_equal(drawn.get_xdata(), t) and np.array_equal(drawn.get_ydata(), values)


def laid_out(figure: Figure) -> Figure:
    FigureCanvasAgg(figure).draw()
    return figure


def legend(axes: Axes) -> list[str]:
    return [text.get_text() for text in axes.get_legend().get_texts()]


# ---- one run


@pytest.mark.parametrize("n_joints", [1, 2, 3, 6])
def test_there_is_a_panel_for_each_joint_and_no_other(n_joints: int) -> None:
    figures = run_figures(trace_of(n_joints=n_joints))
    joints = [f"Joint {i + 1}" for i in range(n_joints)]
    titles = {
        name: [axes.get_title(loc="left") for axes in figure.axes]
        for name, figure in figures.items()
    }
    assert titles["tracking"] == titles["torque"] == joints
    assert titles["error"] == [*joints, "Worst joint"]
    assert titles["learning"] == [
        *(f"Dynamics of {joint.lower()}" for joint in joints),
        "Learning error",
        "Observer error",
        "Weights",
        "Updates",
    ]
    assert titles["theory"] == [
        "Theorem 1",
        "Deep relative trust",
        "Ultimate bound, this loop",
        "Ultimate bound, paper",
        "Lyapunov function",
        "Compute time",
    ]


def test_tracking_error_and_torque_are_the_columns(
    trace: Trace, figures: dict[str, Figure]
) -> None:
    t = trace["t"]
    for i in range(2):
        joint = f"Joint {i + 1}"
        tracking = panel(figures["tracking"], joint)
        assert same(line(tracking, "actual"), t, trace["q"][:, i])
        assert same(line(tracking, "reference"), t, trace["q_ref"][:, i])
        error = trace["q"][:, i] - trace["q_ref"][:, i]
        assert same(line(panel(figures["error"], joint), "actual"), t, error)
        assert same(line(panel(figures["torque"], joint), "actual"), t, trace["tau"][:, i])
    worst = np.abs(trace["q"] - trace["q_ref"]).max(axis=1)
    assert same(line(panel(figures["error"], "Worst joint"), "actual"), t, worst)


def test_learning_is_the_columns(trace: Trace, figures: dict[str, Figure]) -> None:
    figure, t = figures["learning"], trace["t"]
    for i in range(2):
        axes = panel(figure, f"Dynamics of joint {i + 1}")
        assert same(line(axes, "learned"), t, trace["f_hat"][:, 2 + i])
        assert same(line(axes, "true"), t, trace["f_true"][:, 2 + i])
        assert axes.get_ylabel() == ("f₃ (rad/s²)", "f₄ (rad/s²)")[i]
    f_err = np.linalg.norm(trace["f_true"] - trace["f_hat"], axis=1)
    assert same(panel(figure, "Learning error").get_lines()[0], t, f_err)
    e_obs = np.linalg.norm(trace["e_obs"], axis=1)
    assert same(panel(figure, "Observer error").get_lines()[0], t, e_obs)
    for title, column in (("Weights", "weight_norm"), ("Updates", "update_ratio")):
        for k, label in enumerate(("W₁", "W₂", "W₃", "W₄")):
            assert same(line(panel(figure, title), label), t, trace[column][:, k])


def test_theory_is_the_columns(trace: Trace, figures: dict[str, Figure]) -> None:
    figure, t = figures["theory"], trace["t"]
    for k, label in enumerate(("W₁", "W₂", "W₃", "W₄")):
        assert same(line(panel(figure, "Theorem 1"), label), t, trace["eta_bound"][:, k])
        trust = panel(figure, "Deep relative trust")
        assert same(line(trust, label), t, trace["gradient_change"][:, k])
    assert same(line(trust, "bound"), t, trace["drt_bound"])
    eta = trace.scenario.controller.madam.eta
    assert set(line(panel(figure, "Theorem 1"), "η used").get_ydata()) == {eta}
    ours, papers = (panel(figure, f"Ultimate bound, {whose}") for whose in ("this loop", "paper"))
    worst = np.abs(trace["q"] - trace["q_ref"]).max(axis=1)
    assert same(line(ours, "worst |e|"), t, worst)
    assert same(line(ours, "bound"), t, trace["ultimate_bound"])
    assert same(line(papers, "‖eᵣ‖"), t, np.sqrt(trace["lyapunov"]))
    assert same(line(papers, "bound"), t, trace["ultimate_bound_paper"])
    assert same(panel(figure, "Lyapunov function").get_lines()[0], t, trace["lyapunov"])


def test_gradient_change_is_drawn_where_it_was_measured_with_the_bound_of_that_tick() -> None:
    sampled = np.arange(400) // 10 * 10
    fresh = np.random.default_rng(1).uniform(0.1, 1.0, size=(400, 4))[sampled]
    trace = trace_of(gradient_change=fresh)
    trust = panel(run_figures(trace)["theory"], "Deep relative trust")
    every_tenth = slice(None, None, 10)
    assert same(line(trust, "W₁"), trace["t"][every_tenth], fresh[every_tenth, 0])
    assert same(line(trust, "bound"), trace["t"][every_tenth], trace["drt_bound"][every_tenth])


def test_the_static_bound_is_epsilon_of_the_last_half_over_k_lambda() -> None:
    f_true = np.zeros((400, 4))
    f_true[:200] = 100.0  # the first half does not count
    f_true[300] = [1.0, 0.0, 10.0, 0.0]
    inversion = {"K": 5.0, "lam": 2.0}
    trace = trace_of(
        f_true=f_true, f_hat=0.0, parts={"controller": {"kind": "dnn_mso", "inversion": inversion}}
    )
    bound = line(panel(run_figures(trace)["theory"], "Ultimate bound, this loop"), "ε/(Kλ)")
    assert set(bound.get_ydata()) == {(10.0 + 2.0 * 1.0) / (5.0 * 2.0)}


@pytest.mark.parametrize(
    ("inversion", "saturated"),
    [({"K": [1.0, 1.0, 1.0, 2.0]}, 0.0), ({"lam": 0.0}, 0.0), ({}, 1.0)],
    ids=["K is no scalar", "no position feedback", "saturated"],
)
def test_there_is_no_static_bound_where_the_loop_has_no_such_form(
    inversion: dict[str, Any], saturated: float
) -> None:
    parts = {"controller": {"kind": "dnn_mso", "inversion": inversion}}
    trace = trace_of(parts=parts, saturated=saturated, ultimate_bound=-1.0)
    axes = panel(run_figures(trace)["theory"], "Ultimate bound, this loop")
    assert [line.get_label() for line in axes.get_lines()] == ["worst |e|"]


def test_without_a_network_nothing_of_a_network_is_drawn() -> None:
    figures = run_figures(trace_of(n_layers=0))
    assert list(figures) == ["tracking", "error", "torque", "theory"]
    titles = [axes.get_title(loc="left") for axes in figures["theory"].axes]
    assert titles[0] == "Ultimate bound, this loop"
    assert len(titles) == 4


def test_torque_limits_are_drawn_on_both_sides() -> None:
    parts = {"imperfections": {"torque_limit": [60.0, 20.0]}}
    figure = run_figures(trace_of(parts=parts))["torque"]
    for i, limit in enumerate((60.0, 20.0)):
        lines = panel(figure, f"Joint {i + 1}").get_lines()
        levels = {line.get_ydata()[0] for line in lines if line.get_label() == "limit"}
        assert levels == {-limit, limit}
    assert legend(figure.axes[0]) == ["actual", "limit"]


def test_compute_time_counts_every_tick_and_names_percentiles_and_period() -> None:
    times = np.r_[np.full(399, 50.0), 2.5e5]  # one very slow tick
    axes = panel(run_figures(trace_of(compute_us=times))["theory"], "Compute time")
    (counts,) = (patch.get_data() for patch in axes.patches)
    assert counts.values.sum() == 400
    assert counts.values[-1] == 1
    assert axes.get_ylim()[0] == 0.5  # so a count of one has a height
    assert round(np.percentile(times, 99.9), -4) == 150_000
    assert legend(axes) == ["p50 50", "p99.9 150000", "period 1000"]


@pytest.mark.parametrize("n_joints", [2, 5])
def test_all_axes_have_units_and_the_lowest_panels_have_times(n_joints: int) -> None:
    for figure in run_figures(trace_of(n_joints=n_joints)).values():
        for axes in figure.axes:
            assert re.search(r" \(.+\)$", axes.get_ylabel())
        for axes in figure.axes[-1 if len(figure.axes) <= 4 else -2 :]:
            assert re.search(r" \((s|µs)\)$", axes.get_xlabel())
            assert axes.xaxis.get_tick_params()["labelbottom"]


def test_legends_stand_above_the_axes_and_hide_no_data() -> None:
    for figure in run_figures(trace_of(compute_us=1234.5)).values():
        for axes in laid_out(figure).axes:
            around, frame = axes.get_tightbbox(), axes.get_window_extent()
            assert figure.bbox.x0 <= around.x0
            assert around.x1 <= figure.bbox.x1
            assert figure.bbox.y0 <= around.y0
            if axes.get_legend():
                box = axes.get_legend().get_window_extent()
                assert box.y0 >= frame.y1
                (title,) = (
                    text
                    for text in axes.findobj(Text)
                    if text.get_text() == axes.get_title(loc="left")
                )
                assert box.x0 > title.get_window_extent().x1


def overlap(a: Bbox, b: Bbox) -> bool:
    return bool(a.x0 < b.x1 and b.x0 < a.x1 and a.y0 < b.y1 and b.y0 < a.y1)


@pytest.mark.parametrize("n_joints", [1, 2, 6])
def test_panels_labels_and_titles_keep_clear_of_each_other(n_joints: int) -> None:
    long_numbers = {"q": -0.0075, "q_ref": 0.0, "f_hat": -7512.0, "f_true": 9.9e3, "tau": -0.025}
    for figure in run_figures(trace_of(n_joints=n_joints, **long_numbers)).values():
        around = [axes.get_tightbbox() for axes in laid_out(figure).axes]
        (title,) = (t for t in figure.texts if t.get_text() == figure.get_suptitle())
        around.append(title.get_window_extent())
        for k, box in enumerate(around):
            assert not any(overlap(box, other) for other in around[:k])
        for axes in figure.axes:
            low, high = sorted(axes.get_ylim())
            label = axes.yaxis.label.get_window_extent()
            for tick in axes.get_yticklabels():
                if low <= tick.get_position()[1] <= high:
                    assert not overlap(tick.get_window_extent(), label), tick.get_text()


def test_time_runs_to_the_end_of_the_last_period(figures: dict[str, Figure]) -> None:
    assert figures["tracking"].axes[0].get_xlim() == pytest.approx((0.0, 0.4))


def test_the_title_says_what_became_of_the_run() -> None:
    well = run_figures(trace_of(seed=7))["error"]
    assert well.get_suptitle() == "synthetic, seed 7"
    badly = run_figures(trace_of(n_ticks=251, status="diverged"))["error"]
    assert badly.get_suptitle() == "synthetic, seed 0: diverged at t = 0.25 s"


@pytest.mark.parametrize(
    "columns",
    [
        {"n_ticks": 1},
        {name: 0.0 for name in StepLayout(2, 4).widths if name != "t"},
        {"q": 1e150, "tau": -1e150, "lyapunov": 1e300},
    ],
    ids=["one tick", "zeros", "huge"],
)
def test_strange_traces_are_drawn_without_a_warning(columns: dict[str, Any]) -> None:
    for figure in run_figures(trace_of(**{"n_joints": 1, **columns})).values():
        laid_out(figure)


def test_a_network_of_many_layers_names_its_first_and_last() -> None:
    axes = panel(run_figures(trace_of(n_layers=20))["learning"], "Weights")
    assert legend(axes) == ["W₁", "W₂₀"]
    assert len(axes.get_lines()) == 20


def test_a_simulated_run_is_drawn_as_it_was_logged(
    make_scenario: Callable[..., Scenario], two_link: Mjcf
) -> None:
    trace = simulate(make_scenario(duration=0.2), two_link)
    figures = run_figures(trace)
    drawn = line(panel(figures["tracking"], "Joint 2"), "actual")
    assert same(drawn, trace["t"], trace["q"][:, 1])
    assert set(figures) == {"tracking", "error", "torque", "learning", "theory"}


# ---- several runs


def test_a_comparison_draws_every_run_and_a_common_reference_once() -> None:
    q_ref = np.sin(np.arange(400))
    first, second = (trace_of(q_ref=q_ref, seed=seed) for seed in (1, 2))
    shorter = trace_of(n_ticks=150, q_ref=q_ref[:150], seed=3)
    figures = comparison_figures([shorter, first, second], ["short", "a", "b"])
    axes = figures["tracking"].axes[0]
    assert legend(axes) == ["short", "a", "b", "reference"]
    assert same(line(axes, "b"), second["t"], second["q"][:, 0])
    assert same(line(axes, "reference"), first["t"], first["q_ref"][:, 0])
    assert axes.get_xlim() == pytest.approx((0.0, 0.4))
    assert legend(figures["error"].axes[0]) == legend(figures["torque"].axes[0]) == legend(axes)[:3]


def test_a_comparison_draws_references_that_differ() -> None:
    traces = [trace_of(q_ref=0.1), trace_of(q_ref=0.2)]
    axes = comparison_figures(traces, ["a", "b"])["tracking"].axes[0]
    drawn = [line.get_ydata()[0] for line in axes.get_lines() if line.get_label() == "reference"]
    assert sorted(drawn) == [0.1, 0.2]


def test_a_smooth_torque_lies_over_a_chattering_one_whatever_the_order() -> None:
    rough = trace_of(tau=np.where(np.arange(400) % 2, 5.0, -5.0))
    smooth = trace_of(tau=np.linspace(0.0, 1.0, 400))
    for traces, labels in (([rough, smooth], ["r", "s"]), ([smooth, rough], ["s", "r"])):
        axes = comparison_figures(traces, labels)["torque"].axes[0]
        assert line(axes, "s").get_zorder() > line(axes, "r").get_zorder()


def test_many_runs_with_long_names_keep_their_legend_on_the_page_and_their_colours_apart() -> None:
    labels = [f"paper-{'long-name' * 5}-seed-{k}" for k in range(9)]
    traces = [trace_of(50, n_joints=1, n_layers=0, seed=k) for k in range(9)]
    figure = laid_out(comparison_figures(traces, labels)["tracking"])
    box = figure.axes[0].get_legend().get_window_extent()
    assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1
    assert figure.bbox.y0 <= box.y0 < box.y1 <= figure.bbox.y1
    assert len({line(figure.axes[0], label).get_color() for label in labels}) == 9


def test_a_dollar_in_a_label_is_text() -> None:
    figures = comparison_figures([trace_of(), trace_of()], ["$\\nope$", "b"])
    assert legend(laid_out(figures["error"]).axes[0])[0] == "\\$\\nope\\$"


@pytest.mark.parametrize(
    ("traces", "labels", "message"),
    [
        ([], [], "labels [] for 0 runs"),
        ([trace_of(5)], ["a", "b"], "labels ['a', 'b'] for 1 runs"),
        ([trace_of(5), trace_of(5)], ["a", "a"], "one label of its own for each"),
        ([trace_of(5), trace_of(5, n_joints=3)], ["a", "b"], "runs with [2, 3] joints"),
        ([trace_of(5), trace_of(0)], ["a", "b"], "run b has 0 ticks"),
    ],
)
def test_runs_that_cannot_be_compared_are_refused(
    traces: list[Trace], labels: list[str], message: str, tmp_path: Path
) -> None:
    with pytest.raises(DnnmsoError, match=re.escape(message)):
        save_comparison(traces, labels, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_run_without_ticks_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DnnmsoError, match="run synthetic has 0 ticks"):
        save_figures(trace_of(0), tmp_path, "empty")
    assert list(tmp_path.iterdir()) == []


# ---- long runs


@pytest.mark.parametrize("n_ticks", [3_001, 123_457])
@pytest.mark.parametrize("where", [0, 1, 2321, -2, -1])
@pytest.mark.parametrize("size", [7.0, -7.0])
def test_no_spike_is_lost_in_a_long_line(n_ticks: int, where: int, size: float) -> None:
    values = np.sin(np.arange(n_ticks) * 0.01)
    values[where] = size
    drawn = envelope(values)
    assert where % n_ticks in drawn
    assert np.all(np.diff(drawn) > 0)
    assert {0, n_ticks - 1} <= set(drawn.tolist())
    assert len(drawn) <= 3_002


def test_a_short_line_is_drawn_whole() -> None:
    assert np.array_equal(envelope(np.zeros(3_000)), np.arange(3_000))


def test_every_bucket_keeps_its_extremes() -> None:
    values = np.random.default_rng(3).normal(size=200_000)
    drawn = envelope(values)
    for start in range(0, 200_000, 1000):
        piece = values[start : start + 1000]
        kept = drawn[(drawn >= start) & (drawn < start + 1000)]
        assert values[kept].min() == piece.min()
        assert values[kept].max() == piece.max()


def test_gaps_stay_gaps_and_hide_no_spike() -> None:
    values = np.ones(100_000)
    values[::2] = np.nan
    values[50_000:60_000] = np.nan
    values[12_345], values[23_457] = 9.0, -9.0
    drawn = envelope(values)
    assert {12_345, 23_457} <= set(drawn.tolist())
    assert np.isnan(values[drawn[(drawn >= 50_100) & (drawn < 59_900)]]).all()


def test_a_one_tick_spike_of_torque_is_in_the_figure_of_a_long_run() -> None:
    tau = np.zeros((100_000, 2))
    tau[77_777, 1] = 250.0
    figure = run_figures(trace_of(100_000, n_layers=0, tau=tau))["torque"]
    drawn = line(panel(figure, "Joint 2"), "actual")
    assert len(drawn.get_xdata()) <= 3_002
    (spike,) = np.flatnonzero(drawn.get_ydata() == 250.0)
    assert drawn.get_xdata()[spike] == 77.777


def test_a_logarithmic_line_has_gaps_for_zeros_and_none_without_positive_values() -> None:
    _, (axes, empty) = panels(2, 1, "")
    t = np.arange(4.0)
    log_line(axes, t, np.array([1.0, 0.0, -1.0, 10.0]))
    np.testing.assert_array_equal(axes.get_lines()[0].get_ydata(), [1.0, np.nan, np.nan, 10.0])
    log_line(empty, t, np.zeros(4))
    assert len(empty.get_lines()) == 0


# ---- files


def small() -> Trace:
    return trace_of(n_ticks=50, n_joints=1, n_layers=0)


def test_files_are_named_by_the_stem_and_small_even_for_noise(tmp_path: Path) -> None:
    paths = save_figures(trace_of(10_000), tmp_path / "new" / "folder", "noise")
    names = [f"noise_{name}.png" for name in ("tracking", "error", "torque", "learning", "theory")]
    assert [path.name for path in paths] == names
    assert sorted(p.name for p in (tmp_path / "new" / "folder").iterdir()) == sorted(names)
    for path in paths:
        with Image.open(path) as picture:
            assert picture.format == "PNG"
            assert picture.width == 1350
        assert path.stat().st_size <= 150_000


def test_a_comparison_is_saved_beside_the_runs(tmp_path: Path) -> None:
    paths = save_comparison([trace_of(seed=1), trace_of(seed=2)], ["a", "b"], tmp_path)
    assert [p.name for p in paths] == [
        f"comparison_{n}.png" for n in ("tracking", "error", "torque")
    ]


def test_the_same_trace_gives_the_same_bytes_whatever_the_users_style(tmp_path: Path) -> None:
    first = save_figures(small(), tmp_path / "a", "run")
    with mpl.rc_context({"font.size": 30.0, "lines.linewidth": 9.0, "savefig.dpi": 20.0}):
        second = save_figures(small(), tmp_path / "b", "run")
        assert mpl.rcParams["font.size"] == 30.0
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in second]


def test_older_figures_are_replaced_whole(tmp_path: Path) -> None:
    old = tmp_path / "run_error.png"
    old.write_bytes(b"old")
    with old.open("rb") as reader:
        save_figures(small(), tmp_path, "run")
        assert reader.read() == b"old"  # who reads the old file goes on reading it
    assert old.read_bytes().startswith(b"\x89PNG")


def test_a_folder_that_cannot_be_made_is_one_message(tmp_path: Path) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("in the way")
    with pytest.raises(DnnmsoError, match=r"cannot write figure .*run_tracking\.png.*folder"):
        save_figures(small(), blocker, "run")
    assert list(tmp_path.iterdir()) == [blocker]
    assert blocker.read_text() == "in the way"


def test_a_figure_that_cannot_be_replaced_leaves_no_part_behind(tmp_path: Path) -> None:
    (tmp_path / "run_torque.png").mkdir()
    with pytest.raises(DnnmsoError, match=r"cannot write figure .*run_torque\.png"):
        save_figures(small(), tmp_path, "run")
    for path in tmp_path.iterdir():
        assert path.is_dir() or path.read_bytes().startswith(b"\x89PNG")
        assert not path.name.endswith(".part")


def test_a_figure_that_the_disk_has_no_room_for_is_named_and_the_others_are_written(
    tmp_path: Path,
) -> None:
    trace = trace_of(3000)
    sizes = {path: path.stat().st_size for path in save_figures(trace, tmp_path / "a", "run")}
    largest = max(sizes, key=sizes.__getitem__)
    with (
        full_disk(sizes[largest] - 1),
        pytest.raises(DnnmsoError, match=rf"cannot write figure \S*{largest.name}: File too large"),
    ):
        save_figures(trace, tmp_path / "b", "run")
    written = {path.name for path in (tmp_path / "b").iterdir()}
    assert written == {path.name for path in sizes} - {largest.name}


def test_paper_stays_white(tmp_path: Path) -> None:
    for path in save_figures(trace_of(3000), tmp_path, "run"):
        with Image.open(path) as picture:
            colours = picture.convert("RGB").getcolors(1 << 16)
        assert max(colours)[1] == (255, 255, 255)


def test_garbage_collection_goes_on_after_drawing(tmp_path: Path) -> None:
    assert gc.isenabled()
    save_figures(small(), tmp_path, "run")
    assert gc.isenabled()


def test_drawing_needs_no_display_and_no_global_state() -> None:
    code = "import sys, dnnmso_mj.plots; assert 'matplotlib.pyplot' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
