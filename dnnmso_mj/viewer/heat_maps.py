"""The weights of a controller as pictures, one a matrix and a snapshot."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import rerun as rr

from dnnmso_mj.network import network_shape
from dnnmso_mj.scenario import DnnMsoReplay, LewisNn, Network, RbfMso, Scenario
from dnnmso_mj.trace import Array
from dnnmso_mj.viewer.blueprint import RATIOS, WEIGHTS
from dnnmso_mj.viewer.stamps import stamps

_SHOWN = 0.99  # of the values lie within the colours' scale; the rest has the last colour
# From cyan over dark grey, which is zero, to yellow.
_COLORS = rr.components.Colormap.CyanToYellow


class HeatMaps:
    """Weights W, and log₁₀|W/W₀| of those that do not start from zero.

    The scale of a matrix is that of its largest values so far. It stands beside the pictures and
    not in them, so that all pictures of a matrix have the same.

    Args:
        recording: where to.
        scenario: the experiment.
        root: what the paths of all entities begin with.
    """

    def __init__(self, recording: rr.RecordingStream, scenario: Scenario, root: str) -> None:
        self.names, self.from_zero = weight_names(scenario)
        self._recording = recording
        self._scenario = scenario
        self._root = root
        self._first: list[Array] = []
        self._scales: dict[str, float] = {}

    def send(self, t: float, state: Mapping[str, Array]) -> None:
        """The matrices in a controller's state at t (s).

        A state of another controller, as before the branch of a resumed run, leaves a gap.
        """
        matrices = weight_matrices(self._scenario, state)
        if matrices is None:
            return
        self._first = self._first or matrices
        for name, W, W0 in zip(self.names, matrices, self._first, strict=True):
            self._send(f"{self._root}{WEIGHTS}/{name}", t, W)
            if name not in self.from_zero:
                self._send(f"{self._root}{RATIOS}/{name}", t, log_ratio(W, W0))

    def _send(self, path: str, t: float, values: Array) -> None:
        finite = np.abs(values[np.isfinite(values)])  # where a run diverged not all are
        scale = float(np.quantile(finite, _SHOWN)) if finite.size else 0.0
        if scale > self._scales.get(path, -1.0):
            self._scales[path] = scale
            style = rr.DepthImage.from_fields(
                depth_range=[-scale, scale] if scale else [-1.0, 1.0],
                colormap=_COLORS,
                magnification_filter="nearest",
            )
            self._recording.log(path, style, static=True)
        picture = _squared(values).astype(np.float32)
        height, width = picture.shape
        columns = rr.DepthImage.columns(
            buffer=[picture.tobytes()],
            format=[rr.components.ImageFormat(width, height, channel_datatype="F32")],
        )
        times = stamps(np.array([t]), np.array([round(t / self._scenario.dt)]))
        self._recording.send_columns(path, times, columns)


def weight_names(scenario: Scenario) -> tuple[list[str], set[str]]:
    """The weight matrices that a controller has, from the input on; those that start from zero."""
    match scenario.controller:
        case LewisNn():
            return ["V", "W"], {"W"}
        case RbfMso():
            return ["W"], {"W"}
    network = _network(scenario)
    return [f"W{k + 1}" for k in range(len(network.hidden) + 1)] if network else [], set()


def weight_matrices(scenario: Scenario, state: Mapping[str, Array]) -> list[Array] | None:
    """The matrices that `weight_names` names, (outputs, inputs) each, from a controller's state.

    None where the state is not one of this scenario's controller.
    """
    network, n = _network(scenario), scenario.n_joints
    if network is None:
        names, _ = weight_names(scenario)
        return [state[name].T for name in names] if set(names) <= set(state) else None
    flat = state.get("weights", np.zeros(0))
    for n_out in (n, 2 * n):
        shape = network_shape(network, 2 * n, n_out)
        if shape.n_weights == flat.size:
            return shape.split(flat)
    return None


def log_ratio(W: Array, W0: Array) -> Array:
    """log₁₀|W/W₀| of each weight, 0 where one is zero. N.B. Madam never changes a sign."""
    both = (W != 0.0) & (W0 != 0.0)
    ratio = np.divide(W, W0, out=np.ones_like(W), where=both)
    logarithm: Array = np.log10(np.abs(ratio))
    return logarithm


def _network(scenario: Scenario) -> Network | None:
    controller = scenario.controller
    if isinstance(controller, DnnMsoReplay):
        return controller.network.as_network()
    network = getattr(controller, "network", None)
    return network if isinstance(network, Network) else None


def _squared(values: Array) -> Array:
    """Each entry as a block of pixels, so that the picture is about as high as it is wide."""
    rows, columns = values.shape
    tall, wide = max(1, round(columns / rows)), max(1, round(rows / columns))
    return np.repeat(np.repeat(values, tall, axis=0), wide, axis=1)
