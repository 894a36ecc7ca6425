"""Put what is not finite into a run, at a tick and a place; and watch what MuJoCo is given."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dnnmso_mj.controllers.dnn_mso import DnnMsoController
from dnnmso_mj.imperfections.actuators import GIVEN, LAGGED
from dnnmso_mj.imperfections.loads import FRICTION
from dnnmso_mj.kernel import learn, output_at
from dnnmso_mj.monitors import Monitors
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.recording import McapRecorder
from dnnmso_mj.run import LoggedRun, run_to_end
from dnnmso_mj.scene import Scene
from dnnmso_mj.simulation import Simulation

Array = np.ndarray
Rng = np.random.Generator

# What a controller has learned, and what its optimiser keeps, by its name in a `state()`.
LEARNED = ("weights", "mean_weights", "theta", "W", "V")
OPTIMISER = ("second_moment", "first_moment")
SEEN = ("qpos", "qvel", "ctrl", "qfrc_applied")


@dataclass
class Witness:
    """What MuJoCo was given that is not finite, at any of its forward passes."""

    passes: int = 0
    bad: list[str] = field(default_factory=list)

    def look(self, _model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """MuJoCo calls this at the beginning of every forward pass."""
        self.passes += 1
        for name in SEEN:
            values = getattr(data, name)
            if not np.isfinite(values).all():
                self.bad.append(f"{name} = {values.tolist()} at {data.time:g} s")


@contextmanager
def witness() -> Iterator[Witness]:
    """Look at all that MuJoCo is given inside, by its own callback."""
    found = Witness()
    mujoco.set_mjcb_control(found.look)
    try:
        yield found
    finally:
        mujoco.set_mjcb_control(None)


@dataclass(frozen=True)
class Fault:
    """One value in one place before tick k.

    Args:
        where: "sensor", "weights", "optimiser", "observer", "gradient", "torque", "force", "state".
        tick: k, before which it is put there.
        value: not finite, or so large that it soon makes something not finite.
        entry: which of the places there are, from 0 to 1.
    """

    where: str
    tick: int
    value: float
    entry: float

    def strike(self, simulation: Simulation) -> None:
        """Put it there."""
        STRIKES[self.where](simulation, self)


def _into(values: Array, fault: Fault) -> None:
    flat = values.reshape(-1)
    flat[int(fault.entry * flat.size)] = fault.value


def _sensor(simulation: Simulation, fault: Fault) -> None:
    """The reading of this very tick."""
    error = simulation.stage.world.sensors.error
    _into(error[fault.tick % len(error), :-1], fault)


def _kept(simulation: Simulation, fault: Fault) -> None:
    state = simulation.controller.state()
    names = places(state)[fault.where]
    with np.errstate(over="ignore"):
        _into(state[names[int(fault.entry * 7919) % len(names)]], fault)
        simulation.controller.restore(state)


def places(state: Mapping[str, Array]) -> dict[str, list[str]]:
    """The arrays of a controller's state that each kind of fault may go to."""
    real = [name for name, values in state.items() if values.dtype.kind == "f" and values.size]
    learned = [name for name in real if name in LEARNED]
    moments = [name for name in real if name in OPTIMISER]
    rest = [name for name in real if name not in {*LEARNED, *OPTIMISER, *Monitors._fields}]
    return {"weights": learned, "optimiser": moments, "observer": rest}


def _torque(simulation: Simulation, fault: Fault) -> None:
    """What is on its way through the drives."""
    actuators = simulation.stage.world.actuators
    if not actuators.prompt and fault.entry < 0.5:
        _into(actuators.held[LAGGED], fault)
    else:
        size = len(actuators.past)
        row = actuators.past[(fault.tick - 1) % size] if size > 1 else actuators.held[GIVEN]
        _into(row, fault)


def _force(simulation: Simulation, fault: Fault) -> None:
    """A push, the friction that a joint was held with, or the force in MuJoCo itself."""
    loads = simulation.stage.world.loads
    if not loads.acting:
        _into(loads.torque, fault)
    elif loads.dry and fault.entry < 0.3 and not math.isfinite(fault.value):  # a guess at it
        _into(loads.held[FRICTION], fault)
    else:
        _into(loads.push[: loads.torque.size], fault)


def _state(simulation: Simulation, fault: Fault) -> None:
    data = simulation.plant.data
    _into(data.qpos if fault.entry < 0.5 else data.qvel, fault)


STRIKES: Mapping[str, Callable[[Simulation, Fault], None]] = {
    "sensor": _sensor,
    "weights": _kept,
    "optimiser": _kept,
    "observer": _kept,
    "torque": _torque,
    "force": _force,
    "state": _state,
}


class BadGradient:
    """A controller that learns once from a gradient with a bad entry; run by the interpreter.

    Args:
        controller: whose network it is.
        fault: which.
    """

    def __init__(self, controller: DnnMsoController, fault: Fault) -> None:
        self._controller, self._fault, self._tick = controller, fault, 0
        self.n_layers = controller.n_layers

    def __getattr__(self, name: str) -> Any:
        return getattr(self._controller, name)

    def update(self, inputs: Any) -> Any:
        command = self._controller.update(inputs)
        if self._tick == self._fault.tick:
            net = self._controller.learner.net
            out = output_at(net)
            with np.errstate(over="ignore"):
                _into(net.deltas[out : out + int(net.layers[-1, 1])], self._fault)
            learn(net)
        self._tick += 1
        return command


class Saboteur:
    """Hands a run tick by tick to a recorder, and strikes before one of them.

    Args:
        recorder: of the run.
        simulation: that is run.
        fault: to be put into it; None: none.
    """

    block = 1

    def __init__(self, recorder: Any, simulation: Simulation, fault: Fault | None) -> None:
        self._recorder, self._simulation, self._fault = recorder, simulation, fault
        self._ticks = 0
        self.times: list[float] = []  # MuJoCo's own

    def append(self, rows: Array) -> None:
        self._recorder.append(rows)
        self._ticks += len(rows)
        self.times.append(self._simulation.plant.data.time)
        self._strike()

    def event(self, event: Any) -> None:
        self._recorder.event(event)

    def snapshot(self, name: str, t: float, arrays: Mapping[str, Array]) -> None:
        self._recorder.snapshot(name, t, arrays)
        if name == "world" and self._ticks == 0:
            self._strike()

    def _strike(self) -> None:
        fault = self._fault
        if fault is not None and fault.where in STRIKES and fault.tick == self._ticks:
            fault.strike(self._simulation)


@dataclass(frozen=True)
class Struck:
    """A logged run with a fault in it.

    Args:
        run: and its log.
        fault: None: none.
        seen: what MuJoCo was given.
        kept: all that the controller kept at the end.
        times: of MuJoCo, after each tick.
        warnings: how often MuJoCo warned of bad positions, velocities, accelerations or controls.
    """

    run: LoggedRun
    fault: Fault | None
    seen: Witness
    kept: Mapping[str, Array]
    times: list[float]
    warnings: int


def run_struck(simulation: Simulation, mjcf: Mjcf, fault: Fault | None, out: Path) -> Struck:
    """A real run, logged as any is, with a fault in it."""
    whole = simulation.controller
    if fault is not None and fault.where == "gradient":
        simulation.controller = BadGradient(whole, fault)
    scenario, layout = simulation.scenario, simulation.layout
    scene = Scene(simulation.plant.model)
    try:
        with witness() as seen, McapRecorder(out, layout, scenario, scene, mjcf.text) as log:
            saboteur = Saboteur(log, simulation, fault)
            done = run_to_end(
                lambda progress: simulation.run(saboteur, progress), log, scenario, layout, None
            )
        kept = simulation.controller.state()
    finally:
        simulation.controller = whole
    kinds = mujoco.mjtWarning
    bad = (kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC, kinds.mjWARN_BADCTRL)
    warnings = sum(int(simulation.plant.data.warning[int(kind)].number) for kind in bad)
    return Struck(done, fault, seen, kept, saboteur.times, warnings)
