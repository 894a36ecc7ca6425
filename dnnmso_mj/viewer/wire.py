"""What a run tells its streamer, as plain data: JSON, and the bytes of arrays after their names.

Nothing that is read here can make the reader run code, whoever wrote it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from dnnmso_mj.scenario import Scenario
from dnnmso_mj.scene import Geom, Inertial, Joint, Link, Scene
from dnnmso_mj.trace import Event, RunInfo, StepLayout

Array = np.ndarray

_NUMBERS = "biuf"  # kinds of dtype that are nothing but their bytes


def opening(scenario: Scenario, scene: Scene, layout: StepLayout) -> bytes:
    """What is run."""
    tip, offset = scene.tip_place
    return _json({
        "scenario": scenario.model_dump_json(),
        "links": [asdict(link) for link in scene.links],
        "geoms": [asdict(geom) for geom in scene.geoms],
        "tip": [tip, offset],
        "layout": asdict(layout),
    })  # fmt: skip


def read_opening(data: bytes) -> tuple[Scenario, Scene, StepLayout]:
    """Undo `opening`."""
    said = json.loads(data)
    tip, offset = said["tip"]
    scene = Scene.of(
        tuple(_link(**link) for link in said["links"]),
        tuple(_geom(**geom) for geom in said["geoms"]),
        (tip, np.array(offset)),
    )
    layout = StepLayout(**said["layout"])
    return Scenario.model_validate_json(said["scenario"]), scene, layout


def ending(info: RunInfo) -> bytes:
    """How a run went."""
    return _json(vars(info) | {"versions": dict(info.versions), "metrics": dict(info.metrics)})


def read_ending(data: bytes) -> RunInfo:
    """Undo `ending`."""
    return RunInfo(**json.loads(data))


def event_bytes(event: Event) -> bytes:
    """An event."""
    return _json(vars(event))


def read_event(data: bytes) -> Event:
    """Undo `event_bytes`."""
    return Event(**json.loads(data))


def snapshot_bytes(t: float, arrays: Mapping[str, Array]) -> bytes:
    """Those of some arrays that hold numbers, and their time t (s)."""
    numbers = {k: np.asarray(v) for k, v in arrays.items() if v.dtype.kind in _NUMBERS}
    head = {name: (array.dtype.str, array.shape) for name, array in numbers.items()}
    return b"\n".join([_json([t, head]), b"".join(v.tobytes() for v in numbers.values())])


def read_snapshot(data: bytes) -> tuple[float, dict[str, Array]]:
    """Undo `snapshot_bytes`."""
    said, _, rest = data.partition(b"\n")
    t, head = json.loads(said)
    arrays, start = {}, 0
    for name, (dtype, shape) in head.items():
        array = np.frombuffer(rest, dtype, math.prod(shape), start)
        arrays[name] = array.reshape(shape)
        start += array.nbytes
    return t, arrays


def _json(value: object) -> bytes:
    """On one line; NumPy's arrays and numbers as lists and numbers."""
    return json.dumps(value, default=lambda array: array.tolist()).encode()


def _link(joint: Any, inertial: Any, xyz: Any, quat_xyzw: Any, **names: str) -> Link:
    return Link(
        **names,
        xyz=np.array(xyz),
        quat_xyzw=np.array(quat_xyzw),
        joint=joint and _joint(**joint),
        inertial=inertial and _inertial(**inertial),
    )


def _joint(axis: Any, limits: Any, **rest: Any) -> Joint:
    return Joint(**rest, axis=np.array(axis), limits=limits and tuple(limits))


def _inertial(mass: float, com: Any, inertia: Any) -> Inertial:
    return Inertial(mass, np.array(com), np.array(inertia))


def _geom(size: Any, xyz: Any, quat_xyzw: Any, rgba: Any, **rest: Any) -> Geom:
    return Geom(
        **rest,
        size=tuple(size),
        xyz=np.array(xyz),
        quat_xyzw=np.array(quat_xyzw),
        rgba=tuple(rgba),
    )
