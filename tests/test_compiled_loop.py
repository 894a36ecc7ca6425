"""The compiled loop: what it stands for, held against MuJoCo and against the interpreted loop."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numba.core.errors import NumbaError

import dnnmso_mj
from dnnmso_mj.compile_loop import _whole
from dnnmso_mj.compiling import compiled
from dnnmso_mj.controllers import compiled_ticks
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.plant import Plant
from dnnmso_mj.scenario import Scenario
from dnnmso_mj.simulation import Simulation, simulate

CLOCKED = {"compute_us", "deadline_missed", "wake_late_us"}


class Wrapped:
    """A controller that keeps its law but not its compiled ticks."""

    def __init__(self, controller) -> None:
        self._controller = controller
        self.n_layers = controller.n_layers

    def __getattr__(self, name):
        return getattr(self._controller, name)

    def update(self, inputs):
        return self._controller.update(inputs)


@pytest.mark.parametrize("integrator", ["rk4", "euler", "implicitfast"])
def test_forward_and_integrate_are_mujocos_step_bit_for_bit(make_scenario, two_link, integrator):
    plant = Plant(make_scenario(plant={"integrator": integrator}), two_link)
    data = mujoco.MjData(plant.model)
    rng = np.random.default_rng(0)
    data.qpos[:], data.qvel[:] = [0.3, -0.7], [1.0, 2.0]
    plant.reset(data.qpos, data.qvel)
    for tau in rng.normal(0.0, 20.0, size=(200, 2)):
        data.ctrl[:] = tau
        mujoco.mj_step(plant.model, data)
        plant.step(tau)
        assert np.array_equal(plant.q, data.qpos)
        assert np.array_equal(plant.qd, data.qvel)


@pytest.mark.parametrize("kind", ["dnn_mso", "no_network", "classical_mso"])
@pytest.mark.parametrize("limit", [None, 20.0])
def test_interpreted_and_compiled_loop_give_the_same_run(make_scenario, two_link, kind, limit):
    scenario = make_scenario({"kind": kind}, duration=1.0, imperfections={"torque_limit": limit})
    simulation = Simulation(scenario, two_link)
    assert compiled_ticks(simulation.controller) is not None
    simulation.controller = Wrapped(simulation.controller)
    assert compiled_ticks(simulation.controller) is None
    recorder = MemoryRecorder(simulation.layout, scenario.n_ticks)
    interpreted = recorder.trace(scenario, simulation.run(recorder))
    compiled = simulate(scenario, two_link)
    for name in set(compiled) - CLOCKED:
        assert np.array_equal(interpreted[name], compiled[name]), name


def test_a_controller_whose_update_is_replaced_is_not_run_by_its_compiled_ticks(
    make_scenario, two_link
):
    controller = Simulation(make_scenario(), two_link).controller
    law = type(controller)

    class Other(law):
        def update(self, inputs):
            return super().update(inputs)

    controller.__class__ = Other
    assert compiled_ticks(controller) is None
    controller.__class__ = law
    assert compiled_ticks(controller) is not None
    controller.update = lambda *_: None
    assert compiled_ticks(controller) is None


@pytest.mark.parametrize("kind", ["dnn_mso", "classical_mso"])
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_watching_the_network_changes_nothing_of_the_run(make_scenario, kind, precision):
    controller = {"kind": kind, "network": {"precision": precision}}
    scenario = make_scenario(controller, duration=1.0)
    watched, alone = simulate(scenario), simulate(scenario, watch=False)
    for name in ("q", "qd", "tau", "x_hat", "f_hat", "f_true", "ultimate_bound"):
        assert np.array_equal(watched[name], alone[name]), name
    assert watched["weight_norm"].all()
    assert not alone["weight_norm"].any()


PROGRAM = (
    "import numpy as np; from dnnmso_mj import kernel; from dnnmso_mj.network import Shape\n"
    "from dnnmso_mj.scenario import Madam\n"
    "shape = Shape((1, 1), bias=False, activation='sigmoid')\n"
    "net = kernel.build_net(shape, np.ones(1), Madam())\n"
    "kernel.forward(net, np.ones(1)); print(net.acts[kernel.output_at(net)])\n"
)


@pytest.fixture
def package(tmp_path) -> Path:
    """A copy of the package without compiled code, which `output` imports and compiles."""
    root = Path(dnnmso_mj.__file__).parent
    ignored = shutil.ignore_patterns("__pycache__")
    return shutil.copytree(root, tmp_path / "dnnmso_mj", ignore=ignored)


def output(package: Path) -> float:
    command = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, cwd=package.parent, capture_output=True, text=True, check=True)
    return float(done.stdout)


def test_a_changed_source_is_compiled_anew_though_its_callers_file_is_not(package):
    """Compiled code holds its callees: numba alone would run the old ones."""
    assert output(package) == 1.0
    copying = package / "compiling.py"
    text = copying.read_text()
    assert "out[i] = values[i]" in text
    copying.write_text(text.replace("out[i] = values[i]", "out[i] = 2.0 * values[i]"))
    assert output(package) == 2.0


def test_compiled_code_of_an_older_version_with_other_names_does_not_hinder(package):
    """numba's index of what is compiled names classes, and cannot be read once they are gone."""
    assert output(package) == 1.0
    for source in package.rglob("*.py"):
        source.write_text(re.sub(r"\bNet\b", "Netting", source.read_text()))
    assert "class Netting" in (package / "kernel.py").read_text()
    assert output(package) == 1.0


def test_a_users_own_compiled_function_is_compiled_anew_when_its_file_changes(tmp_path):
    own = tmp_path / "own.py"
    text = (
        "from dnnmso_mj.compiling import compiled\n\n@compiled\ndef gain(x):\n    return 1.0 * x\n"
    )

    def gain() -> float:
        command = [sys.executable, "-c", "import own; print(own.gain(2.0))"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        return float(done.stdout)

    own.write_text(text)
    assert gain() == 2.0
    own.write_text(text.replace("1.0", "25.0"))
    assert gain() == 50.0


def test_a_simulation_run_twice_is_the_same_run(make_scenario, two_link):
    scenario = make_scenario(duration=0.3)
    simulation = Simulation(scenario, two_link)
    traces = []
    for _ in range(2):
        recorder = MemoryRecorder(simulation.layout, scenario.n_ticks)
        traces.append(recorder.trace(scenario, simulation.run(recorder)))
    for name in set(traces[0]) - CLOCKED:
        assert np.array_equal(traces[0][name], traces[1][name]), name


def test_without_compilation_one_line_says_so():
    command = [sys.executable, "-m", "dnnmso_mj", "run", "paper"]
    done = subprocess.run(
        command,
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("error: NUMBA_DISABLE_JIT is set")


def test_a_scenario_cut_short_of_its_events_can_be_compiled_elsewhere():
    whole = load_scenario("hard")
    tick = whole.model_copy(update={"duration": whole.dt})
    read = Scenario.model_validate_json(_whole(tick))
    assert read.events == whole.events
    assert 20.0 < read.duration < 20.01
    assert Scenario.model_validate_json(_whole(whole)) == whole


def test_what_allocates_does_not_compile():
    """So that no tick does: each function of the loop is compiled this way."""

    def doubled(values: np.ndarray) -> float:
        return (2.0 * values).sum()

    with pytest.raises(NumbaError, match="NRT"):
        compiled(doubled)(np.ones(3))
