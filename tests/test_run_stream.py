"""A run sent in stretches is the same as one sent at once; several are told apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from log_samples import scene
from replay_samples import entities, read_bands, read_component, read_times
from trace_samples import trace_with

from dnnmso_mj.errors import LogError
from dnnmso_mj.log.segments import Segment
from dnnmso_mj.network import network_shape
from dnnmso_mj.reading import Snapshot
from dnnmso_mj.replay import run_names
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.trace import Event, RunInfo, StepLayout, Trace

N_TICKS = 100
PUSHED = [{"kind": "push", "at": 0.03, "duration": 0.02, "torque": [1.0, 0.0]}]


def trace(n_layers: int = 4, n_joints: int = 2, ticks: int = N_TICKS, **parts: Any) -> Trace:
    layout = StepLayout(n_joints, n_layers)
    rows = np.random.default_rng(1).uniform(0.1, 1.0, size=(ticks, layout.width))
    k = np.arange(ticks)
    flags = {"saturated": (k // 20) % 2, "clipped": 0, "deadline_missed": k == 57}
    parts = {"duration": ticks / 1000, "imperfections": {"torque_limit": 60.0}, **parts}
    return trace_with(rows, layout, {"t": k / 1000, **flags}, parts=parts)


def weights(scenario: Scenario, seed: int) -> dict[str, np.ndarray]:
    n_weights = network_shape(scenario.controller.network, 4, 4).n_weights
    return {"weights": np.random.default_rng(seed).normal(size=n_weights)}


def sent(
    out: Path, whole: Trace, stretch: int, snapshots: Sequence[Snapshot] = (), **info: Any
) -> Path:
    """A run in stretches of so many ticks."""
    import rerun as rr

    from dnnmso_mj.viewer.stream import RunStream

    recording = rr.RecordingStream("test")
    memory = recording.memory_recording()
    layout = StepLayout(whole.n_joints, whole.n_layers)
    stream = RunStream(recording, whole.scenario, scene(), layout)
    stream.begin()
    for k in range(0, len(whole), stretch):
        columns = {name: whole[name][k : k + stretch] for name in whole}
        stream.send(replace(whole, columns=columns))
    for snapshot in snapshots:
        stream.snapshot(snapshot.t, snapshot.arrays)
    stream.end(RunInfo(**{"status": "ok", "seed": 0, **info}))
    out.write_bytes(memory.drain_as_bytes())
    return out


def together(out: Path, runs: dict[str, Trace], **options: Any) -> Path:
    from dnnmso_mj.viewer.rrd import Run, rrd_bytes

    shown = [Run(name, run, scene()) for name, run in runs.items()]
    out.write_bytes(rrd_bytes(shown, **options))
    return out


def names(rrd: Path, entity: str) -> list[str]:
    [found] = read_component(rrd, entity, "SeriesLines:names")
    return found


def test_stretches_make_the_same_recording_as_the_whole(tmp_path: Path) -> None:
    run = trace(events=PUSHED)
    once, often = (sent(tmp_path / f"{k}.rrd", run, k) for k in (N_TICKS, 7))
    assert entities(once) == entities(often)
    for entity, component in [
        *((f"plots/{plot}/lines", "Scalars:scalars") for plot in ("torque", "theorem_1", "tip")),
        ("arm/link1/link2", "Transform3D:quaternion"),
        ("trail/actual", "LineStrips3D:strips"),
        ("run", "StateChange:state"),
        ("push", "StateChange:state"),
    ]:
        expected = read_component(once, entity, component)
        assert len(expected) > 1
        assert read_component(often, entity, component) == expected
        np.testing.assert_array_equal(read_times(often, entity), read_times(once, entity))


def test_the_layout_needs_no_data(tmp_path: Path) -> None:
    run = trace()
    empty = replace(run, columns={name: run[name][:0] for name in run})
    rrd = sent(tmp_path / "begun.rrd", empty, 1)
    assert "plots/torque/lines" in {entity.lstrip("/") for entity in entities(rrd)}
    assert names(rrd, "plots/torque/lines") == ["commanded"] * 2 + ["τ1", "τ2"]


def test_times_are_not_cut_but_rounded(tmp_path: Path) -> None:
    rrd = sent(tmp_path / "run.rrd", trace(ticks=2100), 500)
    ns = read_times(rrd, "plots/torque/lines").astype(np.int64)
    np.testing.assert_array_equal(ns, 1_000_000 * np.arange(2100))


def test_a_missed_deadline_outdoes_a_torque_limit(tmp_path: Path) -> None:
    bands = read_bands(sent(tmp_path / "run.rrd", trace(), 33), "run")
    at_limit = "torque limit"
    assert bands == [
        (0.0, "running"),
        (0.02, at_limit),
        (0.04, "running"),
        (0.057, "deadline missed"),
        (0.058, "running"),
        (0.06, at_limit),
        (0.08, "running"),
        (0.1, ""),
    ]


def test_an_end_before_its_time_is_a_band(tmp_path: Path) -> None:
    rrd = sent(tmp_path / "run.rrd", trace(), 50, status="diverged", reason="too fast")
    assert read_bands(rrd, "run")[-2:] == [(0.099, "diverged"), (0.102, "")]
    [text] = read_component(rrd, "summary", "TextDocument:text")[-1]
    assert "0.1 s: diverged: too fast" in text


def test_the_scale_of_the_weights_grows_with_them_for_all_pictures(tmp_path: Path) -> None:
    run = trace()
    small, large = weights(run.scenario, 1), weights(run.scenario, 2)
    large["weights"] *= 10.0
    large["weights"][:50] = np.nan  # as where a run diverged
    snapshots = [Snapshot("controller", 0.05 * k, w) for k, w in enumerate([small, large, small])]
    rrd = sent(tmp_path / "run.rrd", run, 50, snapshots)
    scales = [high for [(_, high)] in read_component(rrd, "weights/W2", "DepthImage:depth_range")]
    expected = [np.quantile(np.abs(w["weights"][320:4480]), 0.99) for w in (small, large)]
    np.testing.assert_allclose(scales, expected)
    np.testing.assert_allclose(
        read_times(rrd, "weights/W2") / np.timedelta64(1, "s"), [0, 0.05, 0.1]
    )


def test_states_of_another_controller_leave_a_gap(tmp_path: Path) -> None:
    """As before the branch of a run that went on with another."""
    run = trace()
    others = [{}, {"weights": np.ones(7)}, weights(run.scenario, 1)]
    snapshots = [Snapshot("controller", 0.05 * k, state) for k, state in enumerate(others)]
    rrd = sent(tmp_path / "run.rrd", run, 50, snapshots)
    assert read_times(rrd, "weights/W1") / np.timedelta64(1, "s") == [0.1]


def test_bands_are_of_the_scenario_in_force(tmp_path: Path) -> None:
    from dnnmso_mj.viewer.rrd import Run, rrd_bytes

    frozen = trace(events=[{"kind": "freeze", "at": 0.0}])
    segments = [Segment(0, trace().scenario), Segment(40, frozen.scenario)]
    out = tmp_path / "branched.rrd"
    out.write_bytes(rrd_bytes([Run("branched", frozen, scene(), (), segments)]))
    assert read_bands(out, "learning") == [(0.0, ""), (0.04, "learning has ended")]
    assert len(read_times(out, "plots/torque/lines")) == N_TICKS


def test_to_look_at_a_run_calls_no_code_from_outside(tmp_path: Path) -> None:
    run = trace(reference={"kind": "external", "python": "no_such_module:motion"})
    rrd = sent(tmp_path / "run.rrd", run, 50)
    drawn = read_component(rrd, "trail/desired", "LineStrips3D:strips")
    way = scene().tip(run["q_ref"][::10])
    np.testing.assert_allclose(np.array(drawn)[:, 0, 1], way, atol=1e-6)


def test_each_run_has_its_name_and_colour_and_the_reference_is_there_once(tmp_path: Path) -> None:
    from dnnmso_mj.viewer.look import COMMON_COLOR, RUN_COLORS

    runs = {"a": trace(), "b": trace(n_layers=0)}
    rrd = together(tmp_path / "both.rrd", runs)
    assert names(rrd, "a/plots/joint_angles/lines") == ["desired", "desired", "a", "a"]
    assert names(rrd, "b/plots/joint_angles/lines") == ["b", "b"]
    for name, color in zip(runs, RUN_COLORS, strict=False):
        [colors] = read_component(rrd, f"{name}/plots/joint_angles/lines", "SeriesLines:colors")
        rgb = [tuple(c >> shift & 255 for shift in (24, 16, 8)) for c in colors]
        assert rgb[-2] == color  # joint 1; joint 2 is lighter
        assert sum(rgb[-1]) > sum(color)
        assert rgb[:-2] == [COMMON_COLOR] * (len(rgb) - 2)
        [[arm]] = read_component(rrd, f"{name}/arm/link1/shapes/rod1", "Capsules3D:colors")
        assert tuple(arm >> shift & 255 for shift in (24, 16, 8)) == color
    found = entities(rrd)
    assert "/a/desired/link1/shapes/rod1" in found
    assert "/b/desired/link1/shapes/rod1" not in found


def test_runs_of_other_lengths_and_steps_keep_their_own_times(tmp_path: Path) -> None:
    runs = {"long": trace(), "short": trace(ticks=40, duration=0.08, dt=0.002)}
    runs["short"] = replace(
        runs["short"], columns={**runs["short"].columns, "t": 0.002 * np.arange(40)}
    )
    rrd = together(tmp_path / "both.rrd", runs)
    for name, run in runs.items():
        times = read_times(rrd, f"{name}/plots/torque/lines") / np.timedelta64(1, "s")
        np.testing.assert_allclose(times, run["t"])


def test_arms_stand_side_by_side_each_with_its_ghost(tmp_path: Path) -> None:
    runs = {name: trace() for name in "abcde"}
    rrd = together(tmp_path / "row.rrd", runs, side_by_side=True)
    places = {
        name: read_component(rrd, f"{name}/arm", "Transform3D:translation")[0][0]
        for name in list(runs)[1:]
    }
    assert 0.0 < places["b"][0] < places["c"][0] < places["d"][0]
    assert (places["e"][0], np.sign(places["e"][2])) == (0.0, -1.0)  # a second row
    assert all(f"/{name}/desired/link1/shapes/rod1" in entities(rrd) for name in runs)


def test_the_summary_has_a_column_for_each_run(tmp_path: Path) -> None:
    runs = {"a": trace(), "b|c": trace()}
    metrics = ({"rmse": 0.5, "diverged": False}, {"rmse": 0.25, "settling_time": None})
    for name, found in zip(runs, metrics, strict=True):
        runs[name] = replace(runs[name], info=RunInfo("ok", 3, metrics=found))
    rrd = together(tmp_path / "both.rrd", runs)
    [[text]] = read_component(rrd, "summary", "TextDocument:text")
    assert "2. **b|c**: synthetic, seed 3, 0.1 s: ok" in text
    assert "| metric | 1 | 2 |" in text
    assert "| rmse | 0.5 | 0.25 |" in text
    assert "| diverged | no | – |" in text


def test_events_say_whose_they_are(tmp_path: Path) -> None:
    event = Event(0.02, "warning", "torque limit reached")
    runs = {name: replace(trace(), events=(event,)) for name in ("a", "b")}
    rrd = together(tmp_path / "both.rrd", runs)
    texts = [read_component(rrd, f"{name}/events", "TextLog:text") for name in runs]
    assert texts == [[[f"{name}, 0.020 s: torque limit reached"]] for name in runs]


def test_arms_with_other_joints_are_refused_by_name(tmp_path: Path) -> None:
    runs = {"two": trace(), "three": trace(n_joints=3, imperfections={})}
    message = "three has 3 joints; allowed: 2, as many as two. Replay them one at a time"
    with pytest.raises(LogError, match=message):
        together(tmp_path / "never.rrd", runs)


def test_more_than_eight_are_refused(tmp_path: Path) -> None:
    runs = {str(k): trace() for k in range(9)}
    with pytest.raises(LogError, match="9 logs; allowed: up to 8"):
        together(tmp_path / "never.rrd", runs)


def test_names_of_runs_are_told_apart() -> None:
    paths = [Path(p) for p in ("/x/paper.mcap", "/y/paper.mcap", "/x/pd.mcap", "/x/pd.mcap")]
    assert run_names(paths[:1]) == ["paper"]
    assert run_names(paths) == ["x/paper", "y/paper", "pd", "pd (2)"]
    # What the viewer's font has not would end it.
    assert run_names([Path("/x/a\u1d40.mcap"), Path("/x/a\u2713.mcap")]) == ["a?", "a? (2)"]
