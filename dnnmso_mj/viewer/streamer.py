"""The process between a run and its viewer: takes what the loop has left for it, and streams it.

`python -m dnnmso_mj.viewer.streamer MEMORY CONTROL ADDRESS`, which `live` starts, is told over the
connection CONTROL what is run, and later how it went; it ends when the connection does. What costs
time, Rerun's encoding and its waiting for the viewer, is done here and not in the loop.
"""

from __future__ import annotations

import contextlib
import os
import queue
import sys
import threading
from multiprocessing.connection import Connection

import numpy as np
import rerun as rr

from dnnmso_mj.scenario import Scenario
from dnnmso_mj.trace import RunInfo, StepLayout, Trace
from dnnmso_mj.viewer.live import EVENT, ROWS, SNAPSHOT, Control
from dnnmso_mj.viewer.ring import Ring
from dnnmso_mj.viewer.rrd import APPLICATION
from dnnmso_mj.viewer.stream import RunStream
from dnnmso_mj.viewer.wire import read_ending, read_event, read_opening, read_snapshot

_LOOK_S = 0.2  # between two looks at the ring: each makes the viewer draw, beside the loop
_BATCH_BYTES = 2 * 2**20  # sent at once: so small that the run's end sees each as a sign of life
_NICE = 10  # the loop comes first


def main() -> None:
    """Stream until the run is over, or the viewer is gone."""
    os.nice(_NICE)
    ring = Ring(int(sys.argv[1]))
    control: Control = Connection(int(sys.argv[2]))
    scenario, scene, layout = read_opening(control.recv_bytes())
    recording = rr.RecordingStream(APPLICATION)
    stream = RunStream(recording, scenario, scene, layout)
    over: queue.SimpleQueue[RunInfo] = queue.SimpleQueue()
    threading.Thread(target=_follow, args=(control, over), daemon=True).start()
    control.send_bytes(b"ready")
    # From here on the viewer is waited for, as long as it takes.
    recording.connect_grpc(sys.argv[3])
    stream.begin()
    info = None
    while info is None:
        with contextlib.suppress(queue.Empty):
            info = over.get(timeout=_LOOK_S)
        while messages := list(ring.take(_BATCH_BYTES)):
            ticks = _send(messages, stream, layout, scenario)
            _deliver(recording, ring)
            ring.tally += ticks
    stream.end(info)
    _deliver(recording, ring)
    recording.disconnect()
    control.send_bytes(b"done")


def _follow(control: Control, over: queue.SimpleQueue[RunInfo]) -> None:
    """Pass on how the run went; end this process when the one that runs is gone."""
    with contextlib.suppress(EOFError, OSError):
        while True:
            over.put(read_ending(control.recv_bytes()))
    os._exit(0)


def _deliver(recording: rr.RecordingStream, ring: Ring) -> None:
    """Wait until the viewer has got everything; end this process if it is gone."""
    try:
        recording.flush()
    except RuntimeError:  # the connection is severed
        ring.close()
        os._exit(0)


def _send(
    messages: list[tuple[int, bytes]], stream: RunStream, layout: StepLayout, scenario: Scenario
) -> int:
    """Send messages, rows as one stretch; the number of these."""
    blocks = [np.frombuffer(content) for kind, content in messages if kind == ROWS]
    if blocks:
        rows = np.concatenate(blocks).reshape(-1, layout.width)
        unfinished = RunInfo("unfinished", scenario.seed)
        stream.send(Trace(layout.columns(rows), scenario, unfinished))
    events = [read_event(content) for kind, content in messages if kind == EVENT]
    if events:
        stream.events(events)
    for kind, content in messages:
        if kind == SNAPSHOT:
            stream.snapshot(*read_snapshot(content))
    return len(rows) if blocks else 0


if __name__ == "__main__":
    main()
