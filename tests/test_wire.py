"""What a run tells its streamer comes out as it went in, and is plain data."""

from __future__ import annotations

from dataclasses import asdict

import mujoco
import numpy as np
import pytest
from log_samples import MJCF

from dnnmso_mj.loading import load_scenario
from dnnmso_mj.paths import scenario_names
from dnnmso_mj.scene import Scene
from dnnmso_mj.trace import Event, RunInfo, StepLayout
from dnnmso_mj.viewer import wire

ODD = """
<mujoco><worldbody><body name="a" pos="0.1 0.2 0.3"><joint name="s" type="slide" range="-1 1"
limited="true" axis="1 1 0" pos="0.3 0 0"/><joint name="h" axis="0 1 1"/><geom size="0.1 0.2 0.3"
type="box" rgba="1 0 0 0.5"/><body><geom type="capsule" size="0.1 0.2"/><site name="tip"
pos="0.1 0.2 0.4"/></body></body></worldbody></mujoco>
"""


@pytest.mark.parametrize("xml", [MJCF, ODD])
def test_a_scene_comes_out_as_it_went_in(xml):
    scene = Scene(mujoco.MjModel.from_xml_string(xml))
    scenario, layout = load_scenario("paper"), StepLayout(2, 4)
    scenario_read, read, layout_read = wire.read_opening(wire.opening(scenario, scene, layout))
    assert (scenario_read, layout_read) == (scenario, layout)
    for part in ("links", "geoms"):
        pairs = zip(getattr(read, part), getattr(scene, part), strict=True)
        assert all(repr(asdict(a)) == repr(asdict(b)) for a, b in pairs)
    n = 1 + max(link.joint.index for link in scene.links if link.joint)
    q = np.random.default_rng(0).normal(size=(5, n))
    assert np.array_equal(read.transforms(q), scene.transforms(q))
    assert np.array_equal(read.tip(q), scene.tip(q))
    assert (read.reach, read.urdf()) == (scene.reach, scene.urdf())


@pytest.mark.parametrize("name", scenario_names())
def test_every_scenario_that_ships_comes_out_as_it_went_in(name):
    scenario, scene = load_scenario(name), Scene(mujoco.MjModel.from_xml_string(MJCF))
    said = wire.opening(scenario, scene, StepLayout(2, 0))
    assert wire.read_opening(said)[0] == scenario


def test_arrays_of_numbers_come_out_as_they_went_in_and_others_are_left_out():
    rng = np.random.default_rng(0)
    arrays = {
        "weights": rng.normal(size=(7, 3)).astype(np.float32),
        "turned": rng.normal(size=(4, 5)).T,
        "nothing": np.zeros((0, 4)),
        "tick": np.array(7),
        "flags": np.array([True, False]),
        "not a number": np.array([np.nan, np.inf, -0.0]),
        "last, of nothing": np.zeros(0),
    }
    words = {"words": np.array(["a"]), "objects": np.array([{}], dtype=object)}
    t, read = wire.read_snapshot(wire.snapshot_bytes(0.1, arrays | words))
    assert t == 0.1
    assert list(read) == list(arrays)
    for name, array in arrays.items():
        assert (read[name].dtype, read[name].shape) == (array.dtype, array.shape), name
        assert read[name].tobytes() == array.tobytes(), name
    assert wire.read_snapshot(wire.snapshot_bytes(1.5, {}))[1] == {}


def test_events_and_the_end_of_a_run_come_out_as_they_went_in():
    event = Event(0.1 + 0.2, "warning", 'a "line"\nwith λ')
    assert wire.read_event(wire.event_bytes(event)) == event
    metrics = {"rmse": np.float64(0.1), "diverged": np.bool_(True), "tau_peak": None, "n": 3}
    info = RunInfo("diverged", 3, 0.5, "q = inf", {"numpy": "2"}, "abc", metrics)
    assert wire.read_ending(wire.ending(info)) == info
