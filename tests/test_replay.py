"""A replay holds what the log holds: every number of every plot, every pose, every event."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from replay_samples import (
    all_plots,
    entities,
    read_bands,
    read_component,
    read_lines,
    read_times,
)

from dnnmso_mj.errors import DnnmsoError, LogError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.plant import Mjcf, build_spec, compile_spec
from dnnmso_mj.reading import read_snapshots, read_trace
from dnnmso_mj.replay import save_rrd
from dnnmso_mj.run import run_logged
from dnnmso_mj.scene import Scene
from dnnmso_mj.trace import Trace

SHORT = ("duration=0.6", "controller.network.hidden=[8, 8]")
SHAPE = ("plant.lengths=[0.7, 1.2]", "plant.masses=[1.0, 1.5]", "imperfections.torque_limit=45")
EVENTS = (
    "events=[{kind: push, at: 0.1, duration: 0.05, torque: [5.0, 0.0]}, "
    "{kind: payload, at: 0.2, mass: 0.5}, {kind: payload, at: 0.4, mass: -0.5}, "
    "{kind: freeze, at: 0.5}]",
)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run of the paper's controller on another arm, of which much happens to it."""
    out = tmp_path_factory.mktemp("log") / "paper.mcap"
    return run_logged(load_scenario("paper", (*SHORT, *SHAPE, *EVENTS)), out).log


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


@pytest.mark.parametrize(
    ("plot", "names"),
    [
        ("joint_angles", ["q_ref", "q"]),
        ("velocities", ["qd_ref", "qd"]),
        ("torque", ["tau_cmd", "tau"]),
        ("weight_norm", ["weight_norm"]),
        ("theorem_1", ["eta_bound"]),
        ("compute_time", ["compute_us"]),
    ],
)
def test_a_plot_has_every_tick_of_the_log(
    rrd: Path, trace: Trace, plot: str, names: list[str]
) -> None:
    columns = [trace[name].reshape(len(trace), -1) for name in names]
    written = read_lines(rrd, plot)
    assert written.shape[0] == len(trace) == 600
    np.testing.assert_array_equal(written, np.concatenate(columns, axis=1))


def test_learned_and_true_dynamics_stand_side_by_side(rrd: Path, trace: Trace) -> None:
    n = trace.n_joints
    for what, rows in (("velocity", slice(0, n)), ("acceleration", slice(n, 2 * n))):
        expected = np.concatenate([trace["f_true"][:, rows], trace["f_hat"][:, rows]], axis=1)
        np.testing.assert_array_equal(read_lines(rrd, f"dynamics_{what}"), expected)


def test_the_knowledge_error_is_their_distance(rrd: Path, trace: Trace) -> None:
    f_err, n = trace["f_true"] - trace["f_hat"], trace.n_joints
    norms = [np.linalg.norm(f_err[:, rows], axis=1) for rows in (slice(n, 2 * n), slice(0, n))]
    np.testing.assert_allclose(read_lines(rrd, "knowledge"), np.log10(norms).T)


def test_times_and_ticks_are_those_of_the_log(rrd: Path, trace: Trace) -> None:
    entity = "plots/joint_angles/lines"
    times = [int(t / np.timedelta64(1, "ns")) for t in read_times(rrd, entity)]
    assert times == [round(t * 1e9) for t in trace["t"]]
    assert read_component(rrd, entity, "tick") == list(range(len(trace)))


def test_each_line_carries_its_own_name_and_colour(rrd: Path, trace: Trace, scene: Scene) -> None:
    for plot in all_plots(trace, scene):
        entity = f"plots/{plot.path}/lines"
        [names] = read_component(rrd, entity, "SeriesLines:names")
        [colors] = read_component(rrd, entity, "SeriesLines:colors")
        assert names == [line.name for line in plot.lines]
        rgb = [tuple(color >> shift & 255 for shift in (24, 16, 8)) for color in colors]
        assert rgb == [line.color for line in plot.lines]


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


def test_the_distance_of_the_tip_is_of_the_robot_in_the_log(
    rrd: Path, trace: Trace, scene: Scene
) -> None:
    away = np.linalg.norm(scene.tip(trace["q"]) - scene.tip(trace["q_ref"]), axis=1)
    np.testing.assert_allclose(read_lines(rrd, "tip")[:, 0], np.log10(away))


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


def test_events_are_there_with_their_time_and_level(rrd: Path, trace: Trace) -> None:
    assert trace.events  # or this test would see nothing
    texts = [text for [text] in read_component(rrd, "events", "TextLog:text")]
    levels = [level for [level] in read_component(rrd, "events", "TextLog:level")]
    expected = sorted(trace.events, key=lambda event: event.t)
    assert texts == [f"{event.t:.3f} s: {event.message}" for event in expected]
    assert levels == [{"warning": "WARN", "info": "INFO"}[event.level] for event in expected]
    times = read_times(rrd, "events") / np.timedelta64(1, "s")
    np.testing.assert_allclose(times, [event.t for event in expected], atol=1e-9)


def test_bands_say_when_what_happens(rrd: Path, trace: Trace) -> None:
    assert read_bands(rrd, "push") == [(0.0, ""), (0.1, "push"), (0.15, "")]
    assert read_bands(rrd, "payload") == [(0.0, ""), (0.2, "+0.5 kg"), (0.4, "")]
    assert read_bands(rrd, "learning") == [(0.0, ""), (0.5, "learning has ended")]
    saturated = trace["saturated"]
    changes = [0, *(1 + np.flatnonzero(np.diff(saturated.astype(int))))]
    assert len(changes) > 2  # or this test would see nothing
    words = {True: "torque limit", False: "running"}
    assert read_bands(rrd, "run") == [
        *((pytest.approx(trace["t"][k]), words[bool(saturated[k])]) for k in changes),
        (0.6, ""),
    ]


def test_weights_are_pictures_of_the_snapshots(rrd: Path, log: Path) -> None:
    first, last = (s.arrays["weights"] for s in read_snapshots(log) if s.name == "controller")
    shapes = [(8, 5), (8, 9), (4, 9)]
    ends = np.cumsum([rows * columns for rows, columns in shapes])
    layers = zip(np.split(first, ends[:-1]), np.split(last, ends[:-1]), shapes, strict=True)
    for k, (before, after, shape) in enumerate(layers, start=1):
        for root, expected in {
            "weights": [before, after],
            "weight_ratios": [np.zeros(before.size), np.log10(after / before)],
        }.items():
            found = pictures(rrd, f"{root}/W{k}")
            for picture, values in zip(found, expected, strict=True):
                down, across = (a // b for a, b in zip(picture.shape, shape, strict=True))
                entries = picture[::down, ::across]
                np.testing.assert_allclose(entries, values.reshape(shape), rtol=1e-5, atol=1e-6)
                assert np.array_equal(np.kron(entries, np.ones((down, across))), picture)


def test_pictures_of_a_matrix_have_one_scale(rrd: Path) -> None:
    for root in ("weights", "weight_ratios"):
        *_, [scale] = read_component(rrd, f"{root}/W2", "DepthImage:depth_range")
        within = [(np.abs(picture) <= scale[1]).mean() for picture in pictures(rrd, f"{root}/W2")]
        assert scale[0] == -scale[1]
        assert min(within) == pytest.approx(0.98, abs=0.02)  # the rest is past the last colour


def pictures(rrd: Path, entity: str) -> list[np.ndarray]:
    """The pictures of an entity in the order of time, as (height, width)."""
    buffers = read_component(rrd, entity, "DepthImage:buffer")
    formats = read_component(rrd, entity, "DepthImage:format")
    return [
        np.array(data, np.uint8).view(np.float32).reshape(size["height"], size["width"])
        for [data], [size] in zip(buffers, formats, strict=True)
    ]


def test_the_layout_is_inside_the_recording(rrd: Path) -> None:
    from rerun.chunk import RrdReader

    reader = RrdReader(rrd)
    [layout], [recording] = reader.blueprints(), reader.recordings()
    assert layout.application_id == recording.application_id  # or the viewer would not use it
    queries = [
        query
        for chunk in reader.stream(store=layout)
        if "ViewContents:query" in (batch := chunk.to_record_batch()).schema.names
        for lines in batch["ViewContents:query"].to_pylist()
        for query in lines
    ]
    plotted = {e.rsplit("/", 1)[0].lstrip("/") for e in entities(rrd) if "/plots/" in e}
    assert {f"{path}/**" for path in plotted} == {q for q in queries if q.startswith("plots/")}


def test_one_tick_is_enough(trace: Trace, scene: Scene, tmp_path: Path) -> None:
    from dnnmso_mj.viewer.rrd import Run, rrd_bytes

    first = replace(trace, columns={name: trace[name][:1] for name in trace})
    (tmp_path / "one.rrd").write_bytes(rrd_bytes([Run("one", first, scene)]))
    assert read_lines(tmp_path / "one.rrd", "joint_angles").shape == (1, 4)


def test_a_torn_log_is_shown_up_to_its_tear(log: Path, tmp_path: Path) -> None:
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(log.read_bytes()[: log.stat().st_size // 2])
    expected = read_trace(torn)
    assert 0 < len(expected) < 600
    written = read_lines(save_rrd(torn, tmp_path / "torn.rrd"), "joint_angles")
    np.testing.assert_array_equal(written[:, 2:], expected["q"])


def test_ten_thousand_ticks_stay_under_15_megabytes(trace: Trace, scene: Scene) -> None:
    from dnnmso_mj.viewer.rrd import Run, rrd_bytes

    rng = np.random.default_rng(0)  # numbers that no compression makes smaller
    columns = {name: rng.uniform(size=(10_000, *trace[name].shape[1:])) for name in trace}
    columns["t"] = np.arange(10_000) * trace.scenario.dt
    assert len(rrd_bytes([Run("long", replace(trace, columns=columns), scene)])) < 15e6


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
    message = "tab 'Learnin'; allowed here: Tracking, Learning, Theory, Timing, Scene"
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
