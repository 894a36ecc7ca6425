"""What a replay plots is decided by the scenario, and every column of a log is in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from log_samples import scene
from trace_samples import trace_with

from dnnmso_mj.loading import load_scenario
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.trace import StepLayout, Trace
from dnnmso_mj.viewer.plot import Line, Plot, joint_color
from dnnmso_mj.viewer.signals import plot_tabs

LAYERS = {"dnn_mso": 4, "dnn_mso_replay": 4, "backstepping": 4, "classical_mso": 4}


def tabs_of(scenario: Scenario) -> dict[str, list[Plot]]:
    layout = StepLayout(scenario.n_joints, LAYERS.get(scenario.controller.kind, 0))
    return plot_tabs(scenario, scene(), layout)


def plot_of(scenario: Scenario, path: str) -> Plot:
    return next(plot for plots in tabs_of(scenario).values() for plot in plots if plot.path == path)


def names(plot: Plot) -> set[str]:
    return {line.name for line in plot.lines}


def paper(*overrides: str) -> Scenario:
    return load_scenario("paper", overrides)


def noise() -> Trace:
    """Positive noise, of a run with everything that a plot can depend on."""
    layout = StepLayout(2, LAYERS["dnn_mso"])
    rows = np.random.default_rng(0).uniform(0.1, 1.0, size=(50, layout.width))
    imperfections = {"torque_limit": 60.0, "position_noise": 1e-3}
    return trace_with(rows, layout, {}, parts={"imperfections": imperfections})


def log10(values: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return np.log10(np.abs(values))


def test_every_column_of_a_log_is_plotted() -> None:
    trace = noise()
    plots = [plot for plots in tabs_of(trace.scenario).values() for plot in plots]
    lines = [line.values(trace) for plot in plots for line in plot.lines]
    for name in set(trace) - {"t", "x_hat"}:  # x_hat is x - e_obs
        for column in trace[name].reshape(len(trace), -1).T.astype(float):
            assert any(
                np.array_equal(line, shown) for line in lines for shown in (column, log10(column))
            ), name


def test_a_line_is_of_the_stretch_that_it_is_given() -> None:
    trace = noise()
    part = replace(trace, columns={name: trace[name][7:11] for name in trace})
    for plots in tabs_of(trace.scenario).values():
        for line in (line for plot in plots for line in plot.lines):
            np.testing.assert_array_equal(line.values(part), line.values(trace)[7:11])


def test_a_joint_has_one_colour_in_all_plots() -> None:
    limited = paper("imperfections.torque_limit=60")
    for path, joints in {
        "joint_angles": ("q1", "q2"),
        "error_log": ("|e1|", "|e2|"),
        "torque": ("τ1", "τ2"),
        "velocities": ("q̇1", "q̇2"),
        "bounds": ("|e1|", "|e2|"),
    }.items():
        colors = {line.name: line.color for line in plot_of(limited, path).lines}
        assert [colors[name] for name in joints] == [joint_color(0), joint_color(1)]
    assert joint_color(0) != joint_color(1)


@pytest.mark.parametrize("kind", ["dnn_mso", "rbf_mso", "pd"])
def test_every_plot_has_a_path_of_its_own(kind: str) -> None:
    tabs = tabs_of(load_scenario("paper", controller=kind))
    paths = [plot.path for plots in tabs.values() for plot in plots]
    assert len(paths) == len(set(paths))


@pytest.mark.parametrize(
    ("kind", "learns"),
    {
        "dnn_mso": True,
        "dnn_mso_replay": True,
        "rbf_mso": True,
        "lewis_nn": True,
        "slotine_li": True,
        "no_network": False,
        "computed_torque": False,
        "pd": False,
    }.items(),
)
def test_only_what_learns_has_the_tab_of_it(kind: str, learns: bool) -> None:
    tabs = tabs_of(load_scenario("paper", controller=kind))
    learning = ["Learning"] if learns else []
    assert list(tabs) == ["Tracking", *learning, "Theory", "Timing", "Scene"]


def test_a_run_without_a_network_has_no_plots_of_one() -> None:
    tabs = tabs_of(load_scenario("paper_no_network"))
    paths = {plot.path for plots in tabs.values() for plot in plots}
    assert "lyapunov" in paths
    assert not paths & {"weight_norm", "update_ratio", "theorem_1", "relative_trust", "knowledge"}


def test_velocities_are_among_the_dynamics_where_they_are_learned() -> None:
    def learned(scenario: Scenario) -> list[str]:
        paths = [plot.path for plot in tabs_of(scenario)["Learning"]]
        return [path for path in paths if path.startswith("dynamics")]

    assert learned(paper()) == ["dynamics_acceleration", "dynamics_velocity"]
    assert learned(paper("controller.network.outputs=kinematic")) == ["dynamics_acceleration"]
    for kind in ("classical_mso", "dnn_mso_replay", "lewis_nn"):
        other = load_scenario("paper", controller=kind)
        assert learned(other) == ["dynamics_acceleration"], kind


@pytest.mark.parametrize(
    "imperfection",
    [
        "position_noise=0.01",
        "velocity_noise=[0.0, 0.1]",
        "position_bias=0.1",
        "velocity_drift=0.1",
        "sensor_delay=0.002",
        "jitter=0.001",
        "encoder_counts=1000",
        "velocity_from=difference",
    ],
)
def test_measured_values_are_drawn_only_where_they_can_differ(imperfection: str) -> None:
    assert names(plot_of(paper(), "joint_angles")) == {"desired", "q1", "q2"}
    noisy = plot_of(paper(f"imperfections.{imperfection}"), "joint_angles")
    assert names(noisy) == {"desired", "measured", "q1", "q2"}


@pytest.mark.parametrize(
    "imperfection",
    ["torque_limit=60", "torque_rate=5000", "actuator_lag=0.01", "actuator_delay=0.002"],
)
def test_commanded_torque_is_drawn_only_where_it_can_differ(imperfection: str) -> None:
    assert names(plot_of(paper(), "torque")) == {"τ1", "τ2"}
    driven = plot_of(paper(f"imperfections.{imperfection}"), "torque")
    assert names(driven) == {"commanded", "τ1", "τ2"}


def test_each_joints_own_torque_limit_is_drawn_in_its_colour() -> None:
    plot = plot_of(paper("imperfections.torque_limit=[70, 30]"), "torque")
    assert [level.value for level in plot.levels] == [70.0, -70.0, 30.0, -30.0]
    assert [level.color for level in plot.levels] == [joint_color(j) for j in (0, 0, 1, 1)]
    assert plot.y_range is not None
    assert plot.y_range[0] < -70.0
    assert plot.y_range[1] > 70.0


@pytest.mark.parametrize(
    ("scenario", "bounds"),
    [
        (load_scenario("paper"), {"bound on |e|", "paper's, on ‖e_r‖"}),
        (paper("controller.inversion.K=[7, 7, 8, 8]"), {"paper's, on ‖e_r‖"}),
        (load_scenario("paper", controller="pd"), set()),
    ],
    ids=["scalar", "one gain a row", "no inversion"],
)
def test_a_bound_that_does_not_exist_is_not_drawn(scenario: Scenario, bounds: set[str]) -> None:
    assert names(plot_of(scenario, "bounds")) - {"|e1|", "|e2|"} == bounds


def test_logarithm_of_an_exact_zero_is_a_gap() -> None:
    trace = noise()
    q = trace["q"].copy()
    q[7] = trace["q_ref"][7]
    lines: tuple[Line, ...] = plot_of(trace.scenario, "error_log").lines
    for line in lines:
        values = line.values(replace(trace, columns={**trace.columns, "q": q}))
        assert np.isnan(values[7])
        assert np.isfinite(np.delete(values, 7)).all()
