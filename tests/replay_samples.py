"""What a Rerun recording holds, and the tabs of a viewer, for the tests of replays."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dnnmso_mj.trace import Array, StepLayout, Trace

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

    from dnnmso_mj.scene import Scene
    from dnnmso_mj.viewer.plot import Plot


@cache
def _batches(rrd: Path) -> dict[str, list]:
    """Entity -> its record batches, of a file that is not written again."""
    from rerun.chunk import RrdReader

    batches: dict[str, list] = defaultdict(list)
    for chunk in RrdReader(rrd).stream():
        batches[chunk.entity_path].append(chunk.to_record_batch())
    return batches


def read_component(rrd: Path, entity: str, component: str) -> list:
    """All rows of a component that an entity has, in the order of time."""
    rows: list = []
    for batch in _batches(rrd)[f"/{entity}"]:
        if component in batch.schema.names:
            values = batch[component].to_pylist()
            timeless = [-1] * len(values)
            ticks = batch["tick"].to_pylist() if "tick" in batch.schema.names else timeless
            rows += zip(ticks, values, strict=True)
    return [value for _, value in sorted(rows, key=lambda row: row[0])]


def read_lines(rrd: Path, plot: str, what: str = "lines") -> Array:
    """The lines of a plot as written, shape (N, lines)."""
    return np.array(read_component(rrd, f"plots/{plot}/{what}", "Scalars:scalars"))


def read_times(rrd: Path, entity: str) -> Array:
    """When an entity has something, as timedelta64[ns], in order."""
    batches = [batch for batch in _batches(rrd)[f"/{entity}"] if "time" in batch.schema.names]
    return np.sort(np.concatenate([batch["time"].to_numpy() for batch in batches]))


def read_bands(rrd: Path, lane: str) -> list[tuple[float, str]]:
    """When each band of a lane begins (s), and its word."""
    words = [word for [word] in read_component(rrd, lane, "StateChange:state")]
    times = read_times(rrd, lane) / np.timedelta64(1, "s")
    return list(zip(times.tolist(), words, strict=True))


def entities(rrd: Path) -> set[str]:
    return set(_batches(rrd))


def all_plots(trace: Trace, scene: Scene) -> list[Plot]:
    from dnnmso_mj.viewer.signals import plot_tabs

    layout = StepLayout(trace.n_joints, trace.n_layers)
    return [plot for plots in plot_tabs(trace.scenario, scene, layout).values() for plot in plots]


def opened_tabs(client: ViewerClient) -> Iterator[str]:
    """Open one tab after another in a running viewer; their names."""
    [recording] = client.get_state().recordings
    blueprint = client.get_blueprint().blueprint
    [tabs] = [
        part["ContainerBlueprint"]
        for part in blueprint.values()
        if part.get("ContainerBlueprint", {}).get("container_kind") == "Tabs"
    ]
    for child in tabs["contents"]:
        tabs["active_tab"] = child
        client.set_blueprint(blueprint, store_id=recording.store_id)
        yield blueprint[f"/{child}"]["ContainerBlueprint"]["display_name"]
