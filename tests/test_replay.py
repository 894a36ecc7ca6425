"""A replay holds what the log holds: every number of every plot, every pose, every event."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dnnmso_mj.errors import DnnmsoError, LogError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.plant import Mjcf, build_spec, compile_spec
from dnnmso_mj.reading import read_trace
from dnnmso_mj.replay import save_rrd
from dnnmso_mj.run import run_logged
from dnnmso_mj.scene import Scene
from dnnmso_mj.trace import Array, Trace
from dnnmso_mj.viewer.signals import Plot, joint_color, plot_tabs

SHORT = ("duration=0.6", "controller.network.hidden=[8, 8]")
SHAPE = ("plant.lengths=[0.7, 1.2]", "plant.masses=[1.0, 1.5]", "imperfections.torque_limit=45")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run of the paper's controller on another arm, with a torque limit it reaches."""
    out = tmp_path_factory.mktemp("log") / "paper.mcap"
    return run_logged(load_scenario("paper", (*SHORT, *SHAPE)), out).log


@pytest.fixture(scope="module")
def trace(log: Path) -> Trace:
    return read_trace(log)


@pytest.fixture(scope="module")
def scene(trace: Trace) -> Scene:
    model = Path(__file__).parents[1] / "models" / "two_link.xml"
    spec = build_spec(trace.scenario.plant, trace.scenario.dt, Mjcf.read(model))
    return Scene(compile_spec(spec, "two_link"))


@pytest.fixture(scope="module")
def rrd(log: Path) -> Path:
    return save_rrd(log, log.with_suffix(".rrd"))


def read_component(rrd: Path, entity: str, component: str) -> list:
    """All rows of a component that an entity has, in the order of time."""
    from rerun.chunk import RrdReader

    rows: list = []
    for chunk in RrdReader(rrd).stream().filter(content=f"/{entity}"):
        batch = chunk.to_record_batch()
        if component in batch.schema.names:
            rows += batch[component].to_pylist()
    return rows


def read_lines(rrd: Path, plot: str, what: str = "lines") -> Array:
    """The lines of a plot as written, shape (N, lines)."""
    return np.array(read_component(rrd, f"plots/{plot}/{what}", "Scalars:scalars"))


def entities(rrd: Path) -> set[str]:
    from rerun.chunk import RrdReader

    return {chunk.entity_path for chunk in RrdReader(rrd).stream()}


def all_plots(trace: Trace) -> list[Plot]:
    return [plot for plots in plot_tabs(trace).values() for plot in plots]


def find_plot(trace: Trace, path: str) -> Plot:
    return next(plot for plot in all_plots(trace) if plot.path == path)


def with_columns(trace: Trace, **columns: Array) -> Trace:
    return replace(trace, columns={**trace.columns, **columns})


@pytest.mark.parametrize(
    ("plot", "first", "names"),
    [
        ("joint_angles", 0, ["q_ref", "q"]),
        ("velocities", 0, ["qd_ref", "qd"]),
        ("torque", 0, ["tau_cmd", "tau"]),
        ("weight_norm", 0, ["weight_norm"]),
        ("theorem_1", 0, ["eta_bound"]),
        ("observer_velocity", 0, ["e_obs"]),
        ("compute_time", 0, ["compute_us"]),
    ],
)
def test_a_plot_has_every_tick_of_the_log(
    rrd: Path, trace: Trace, plot: str, first: int, names: list[str]
) -> None:
    columns = [trace[name].reshape(len(trace), -1) for name in names]
    if plot == "observer_velocity":
        columns = [column[:, trace.n_joints :] for column in columns]
    written = read_lines(rrd, plot)
    assert written.shape[0] == len(trace) == 600
    np.testing.assert_array_equal(written, np.concatenate(columns, axis=1))


def test_learned_and_true_dynamics_stand_side_by_side(rrd: Path, trace: Trace) -> None:
    for row in range(2 * trace.n_joints):
        expected = np.stack([trace["f_true"][:, row], trace["f_hat"][:, row]], axis=1)
        np.testing.assert_array_equal(read_lines(rrd, f"dynamics_{row + 1}"), expected)


def test_every_column_of_a_log_is_plotted(trace: Trace) -> None:
    noisy = with_columns(trace, q_meas=trace["q"] + 1e-3, qd_meas=trace["qd"] + 1e-3)
    lines = [line.values for plot in all_plots(noisy) for line in plot.lines]
    for name in set(noisy) - {"t", "x_hat"}:  # x_hat is x - e_obs
        for column in noisy[name].reshape(len(noisy), -1).T.astype(float):
            with np.errstate(divide="ignore"):
                logarithm = np.log10(np.abs(column))
            logarithm[np.isinf(logarithm)] = np.nan
            assert any(
                np.array_equal(values, column) or np.array_equal(values, logarithm, equal_nan=True)
                for values in lines
            ), name


def test_times_and_ticks_are_those_of_the_log(rrd: Path, trace: Trace) -> None:
    entity = "plots/joint_angles/lines"
    times = [int(t / np.timedelta64(1, "ns")) for t in read_times(rrd, entity)]
    assert times == [round(t * 1e9) for t in trace["t"]]
    assert read_component(rrd, entity, "tick") == list(range(len(trace)))


def read_times(rrd: Path, entity: str) -> Array:
    from rerun.chunk import RrdReader

    chunks = [c.to_record_batch() for c in RrdReader(rrd).stream().filter(content=f"/{entity}")]
    return np.concatenate([c["time"].to_numpy() for c in chunks if "time" in c.schema.names])


def test_each_line_carries_its_own_name_and_colour(rrd: Path, trace: Trace) -> None:
    for plot in all_plots(trace):
        entity = f"plots/{plot.path}/lines"
        [names] = read_component(rrd, entity, "SeriesLines:names")
        [colors] = read_component(rrd, entity, "SeriesLines:colors")
        assert names == [line.name for line in plot.lines]
        rgb = [tuple(color >> shift & 255 for shift in (24, 16, 8)) for color in colors]
        assert rgb == [line.color for line in plot.lines]


def test_a_joint_has_one_colour_in_all_plots(trace: Trace) -> None:
    for path, names in {
        "joint_angles": ("q1", "q2"),
        "error_log": ("|e1|", "|e2|"),
        "torque": ("τ1", "τ2"),
        "velocities": ("q̇1", "q̇2"),
        "bounds": ("|e1|", "|e2|"),
    }.items():
        colors = {line.name: line.color for line in find_plot(trace, path).lines}
        assert [colors[name] for name in names] == [joint_color(0), joint_color(1)]
    assert joint_color(0) != joint_color(1)


def test_every_plot_has_a_path_of_its_own(trace: Trace) -> None:
    paths = [plot.path for plot in all_plots(trace)]
    assert len(paths) == len(set(paths))


@pytest.mark.parametrize(("root", "column"), [("arm", "q"), ("desired", "q_ref")])
def test_links_move_as_the_log_says(
    rrd: Path, trace: Trace, scene: Scene, root: str, column: str
) -> None:
    poses = scene.transforms(trace[column][::10])  # 1 kHz shown at 100 Hz
    for k, entity in enumerate([f"{root}/link1", f"{root}/link1/link2"]):
        xyz = np.array(read_component(rrd, entity, "Transform3D:translation"))[:, 0]
        quat = np.array(read_component(rrd, entity, "Transform3D:quaternion"))[:, 0]
        np.testing.assert_allclose(xyz, poses[:, k, :3], atol=1e-6)  # Rerun's are float32
        np.testing.assert_allclose(quat, poses[:, k, 3:], atol=1e-6)
    assert xyz[0][0] == pytest.approx(0.7)  # the scenario's length, not the model file's
    np.testing.assert_array_equal(read_component(rrd, entity, "tick"), np.arange(0, 600, 10))


def test_trail_follows_the_tip(rrd: Path, trace: Trace, scene: Scene) -> None:
    stretches = np.array(read_component(rrd, "trail/actual", "LineStrips3D:strips"))[:, 0]
    tip = scene.tip(trace["q"][::10])
    np.testing.assert_allclose(stretches[:, 1], tip, atol=1e-6)
    np.testing.assert_allclose(stretches[1:, 0], tip[:-1], atol=1e-6)
    [[path]] = read_component(rrd, "trail/desired", "LineStrips3D:strips")
    np.testing.assert_allclose(path, scene.tip(trace["q_ref"][::10]), atol=1e-6)


def test_shapes_are_drawn_for_the_arm_and_for_its_ghost(rrd: Path, scene: Scene) -> None:
    found = entities(rrd)
    for root in ("arm", "desired"):
        links = {"link1": f"/{root}/link1", "link2": f"/{root}/link1/link2", "world": f"/{root}"}
        for geom in scene.geoms:
            fixed = geom.body == "world" and root == "desired"  # what stands still has no ghost
            assert (f"{links[geom.body]}/shapes/{geom.name}" in found) != fixed
    [[arm]] = read_component(rrd, "arm/link1/shapes/rod1", "Capsules3D:colors")
    [[ghost]] = read_component(rrd, "desired/link1/shapes/rod1", "Capsules3D:colors")
    assert arm & 255 == 255
    assert 0 < ghost & 255 < 128  # translucent


def test_torque_limit_is_drawn_over_the_whole_run(rrd: Path, trace: Trace) -> None:
    np.testing.assert_array_equal(read_lines(rrd, "torque", "levels"), [[45.0, -45.0]] * 2)
    times = read_times(rrd, "plots/torque/levels") / np.timedelta64(1, "s")
    np.testing.assert_allclose(times, trace["t"][[0, -1]])


def test_each_joints_own_torque_limit_is_drawn_in_its_colour(trace: Trace) -> None:
    limits = trace.scenario.imperfections.model_copy(update={"torque_limit": (45.0, 20.0)})
    scenario = trace.scenario.model_copy(update={"imperfections": limits})
    levels = find_plot(replace(trace, scenario=scenario), "torque").levels
    assert [level.value for level in levels] == [45.0, -45.0, 20.0, -20.0]
    assert [level.color for level in levels] == [joint_color(j) for j in (0, 0, 1, 1)]


def test_events_are_there_with_their_time_and_level(rrd: Path, trace: Trace) -> None:
    assert trace.events  # or this test would see nothing
    texts = [text for [text] in read_component(rrd, "events", "TextLog:text")]
    levels = [level for [level] in read_component(rrd, "events", "TextLog:level")]
    assert texts == [f"{event.t:.3f} s: {event.message}" for event in trace.events]
    assert levels == [{"warning": "WARN", "info": "INFO"}[event.level] for event in trace.events]
    times = read_times(rrd, "events") / np.timedelta64(1, "s")
    np.testing.assert_allclose(times, [event.t for event in trace.events], atol=1e-9)


def test_the_layout_is_inside_the_recording(rrd: Path) -> None:
    from rerun.chunk import RrdReader

    reader = RrdReader(rrd)
    [layout], [recording] = reader.blueprints(), reader.recordings()
    assert layout.application_id == recording.application_id  # or the viewer would not use it
    origins = [
        origin
        for chunk in reader.stream(store=layout)
        if "ViewBlueprint:space_origin" in (batch := chunk.to_record_batch()).schema.names
        for [origin] in batch["ViewBlueprint:space_origin"].to_pylist()
    ]
    plotted = {f"/{e}".rsplit("/", 1)[0].lstrip("/") for e in entities(rrd) if "/plots/" in e}
    assert plotted == {origin.lstrip("/") for origin in origins if "plots/" in origin}


def test_a_run_without_a_network_has_no_plots_of_one(tmp_path: Path) -> None:
    out = tmp_path / "plain.mcap"
    run_logged(load_scenario("paper_no_network", ("duration=0.05",)), out)
    tabs = plot_tabs(read_trace(out))
    assert list(tabs) == ["Tracking", "Motion", "Theory", "Timing"]
    found = entities(save_rrd(out, tmp_path / "plain.rrd"))
    assert "/plots/lyapunov/lines" in found
    assert not any(
        word in entity
        for word in ("weight", "update", "theorem_1", "relative_trust", "dynamics")
        for entity in found
    )


def test_measured_values_are_drawn_only_where_they_differ(trace: Trace) -> None:
    exact = find_plot(trace, "joint_angles")
    noisy = find_plot(with_columns(trace, q_meas=trace["q"] + 0.01), "joint_angles")
    assert [line.name for line in exact.lines] == ["q1 ref", "q2 ref", "q1", "q2"]
    assert "q2 measured" in [line.name for line in noisy.lines]


def test_commanded_torque_is_drawn_only_where_it_differs(trace: Trace) -> None:
    same = find_plot(with_columns(trace, tau_cmd=trace["tau"]), "torque")
    assert "τ1 commanded" in [line.name for line in find_plot(trace, "torque").lines]
    assert [line.name for line in same.lines] == ["τ1", "τ2"]


def test_a_bound_that_does_not_exist_is_not_drawn(trace: Trace) -> None:
    without = with_columns(trace, ultimate_bound=np.full(len(trace), -1.0))
    names = [line.name for line in find_plot(trace, "bounds").lines]
    left = [line.name for line in find_plot(without, "bounds").lines]
    assert set(names) - set(left) == {"bound on |e|"}


def test_logarithm_of_an_exact_zero_is_a_gap(trace: Trace) -> None:
    q = trace["q"].copy()
    q[7] = trace["q_ref"][7]
    lines = find_plot(with_columns(trace, q=q), "error_log").lines
    for line in lines:
        assert np.isnan(line.values[7])
        assert np.isfinite(np.delete(line.values, 7)).all()


def test_one_tick_is_enough(trace: Trace, scene: Scene, tmp_path: Path) -> None:
    from dnnmso_mj.viewer.rrd import rrd_bytes

    first = replace(trace, columns={name: trace[name][:1] for name in trace})
    (tmp_path / "one.rrd").write_bytes(rrd_bytes(first, scene))
    assert read_lines(tmp_path / "one.rrd", "joint_angles").shape == (1, 4)


def test_a_torn_log_is_shown_up_to_its_tear(log: Path, tmp_path: Path) -> None:
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(log.read_bytes()[: log.stat().st_size // 2])
    expected = read_trace(torn)
    assert 0 < len(expected) < 600
    written = read_lines(save_rrd(torn, tmp_path / "torn.rrd"), "joint_angles")
    np.testing.assert_array_equal(written[:, 2:], expected["q"])


def test_ten_thousand_ticks_stay_under_15_megabytes(trace: Trace, scene: Scene) -> None:
    from dnnmso_mj.viewer.rrd import rrd_bytes

    rng = np.random.default_rng(0)  # numbers that no compression makes smaller
    columns = {name: rng.uniform(size=(10_000, *trace[name].shape[1:])) for name in trace}
    columns["t"] = np.arange(10_000) * trace.scenario.dt
    assert len(rrd_bytes(replace(trace, columns=columns), scene)) < 15e6


def test_an_existing_file_is_replaced(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    out.write_text("old")
    assert save_rrd(log, out) == out
    assert read_lines(out, "joint_angles").shape == (600, 4)
    assert list(tmp_path.iterdir()) == [out]


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    out, bad = tmp_path / "out.rrd", tmp_path / "bad.mcap"
    out.write_text("old")
    bad.write_text("no log")
    with pytest.raises(LogError, match=r"bad\.mcap"):
        save_rrd(bad, out)
    assert out.read_text() == "old"
    assert set(tmp_path.iterdir()) == {out, bad}


def test_a_log_is_never_overwritten_by_its_replay(log: Path) -> None:
    before = log.read_bytes()
    with pytest.raises(LogError, match=r"paper\.mcap: allowed: a file name that ends in \.rrd"):
        save_rrd(log, log)
    assert log.read_bytes() == before


def test_a_missing_folder_is_refused(log: Path, tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"nowhere/out\.rrd cannot be written: No such file"):
        save_rrd(log, tmp_path / "nowhere" / "out.rrd")
    assert not list(tmp_path.iterdir())


def test_a_folder_in_the_way_is_refused(log: Path, tmp_path: Path) -> None:
    (tmp_path / "out.rrd").mkdir()
    with pytest.raises(LogError, match=r"out\.rrd cannot be written"):
        save_rrd(log, tmp_path / "out.rrd")
    assert [path.name for path in tmp_path.iterdir()] == ["out.rrd"]


def test_an_unknown_tab_is_refused_with_those_there_are(log: Path, tmp_path: Path) -> None:
    message = "tab 'Learnin'; this run has: Tracking, Motion, Learning, Theory, Timing"
    with pytest.raises(DnnmsoError, match=message):
        save_rrd(log, tmp_path / "out.rrd", first_tab="Learnin")
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_an_error_and_leaves_nothing(log: Path, tmp_path: Path) -> None:
    """Rerun's own writer would wait for ever."""
    code = (
        "import resource, sys; from pathlib import Path; from dnnmso_mj.replay import save_rrd\n"
        "from dnnmso_mj.errors import LogError\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "try: save_rrd(Path(sys.argv[1]), Path(sys.argv[2]))\n"
        "except LogError as error: print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, log, tmp_path / "out.rrd"],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert "out.rrd cannot be written: File too large" in done.stdout
    assert not list(tmp_path.iterdir())


def test_without_rerun_the_message_says_what_to_install(log: Path, tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules['rerun'] = None\n"
        "from pathlib import Path; from dnnmso_mj.replay import save_rrd\n"
        "from dnnmso_mj.errors import MissingExtraError\n"
        "try: save_rrd(Path(sys.argv[1]), Path(sys.argv[2]))\n"
        "except MissingExtraError as error: print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, log, tmp_path / "out.rrd"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "pip install 'dnnmso_mj[viewer]'" in done.stdout
    assert not list(tmp_path.iterdir())
