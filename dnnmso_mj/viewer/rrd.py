"""Runs as the content of a Rerun file, with the layout to see them in."""

from __future__ import annotations

from collections.abc import Sequence

import rerun as rr

from dnnmso_mj.reading import Snapshot
from dnnmso_mj.scene import Scene
from dnnmso_mj.trace import StepLayout, Trace
from dnnmso_mj.viewer.stream import RunStream

APPLICATION = "dnnmso"


def rrd_bytes(
    trace: Trace,
    scene: Scene,
    first_tab: str = "Tracking",
    snapshots: Sequence[Snapshot] = (),
) -> bytes:
    """The content of a .rrd file: a run, and the layout to see it in.

    It is made in memory, since Rerun's own writer waits for ever on a full disk.

    Args:
        trace: the run, of at least one tick.
        scene: the robot it is a run of.
        first_tab: the tab that is open at first, a key of `signals.plot_tabs`.
        snapshots: of its controller.

    Raises:
        LogError: there is no such tab.
    """
    recording = rr.RecordingStream(APPLICATION)
    memory = recording.memory_recording()
    layout = StepLayout(trace.n_joints, trace.n_layers)
    stream = RunStream(recording, trace.scenario, scene, layout)
    stream.begin(first_tab)
    send_run(stream, trace, snapshots)
    return memory.drain_as_bytes()


def send_run(stream: RunStream, trace: Trace, snapshots: Sequence[Snapshot]) -> None:
    """Send a whole run that has begun."""
    stream.send(trace)
    stream.events(trace.events)
    for snapshot in snapshots:
        if snapshot.name == "controller":
            stream.snapshot(snapshot.t, snapshot.arrays)
    stream.end(trace.info)
